"""Check the wording of Markdown pages, docstrings, comments and messages.

    python tools/prose.py PATH...     print each finding as ``path:line: rule: text -> advice``
    python tools/prose.py --gate      compare every area's findings per 1,000 words with tools/limits.toml
    python tools/prose.py --areas     print the table of all areas

An area is a key of ``[prose]`` in the limits: a folder or a file. A file belongs to the longest key that
matches. Standard library only.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LIMITS = ROOT / "tools" / "limits.toml"
MAX_SENTENCE_WORDS, MAX_SENTENCE_NUMBERS = 25, 4
GENERATED = ("magbridge/mavlink/dialect.py", "magbridge/mavlink/enums.py")
QUOTED = ("tools/prose.py", "tests/tools/test_gate.py")
"""Files that contain the forbidden words because they search for them."""

RULES = {
    "said": (
        r"\b(?:is|are|was|were|be) (?:\w+ly |also |then )?(?:said|told)\b|\bsays so\b",
        "name the program and the channel: 'the bridge sends a STATUSTEXT'",
    ),
    "anew": (r"\banew\b", "again, or a verb with re-: refit, restart"),
    "beside": (r"\bbeside\b", "next to, in addition to, given, compared with"),
    "but-for": (r"\bbut for\b", "except"),
    "nobody": (r"\bnobody\b", "state what is unknown or not allowed"),
    "is-no": (
        r"\b(?:is|are|was|were) no (?!longer|more|less|fewer|such|need|reason|way|guarantee)[a-z]+",
        "is not a ...",
    ),
    "foretell": (r"\bforet(?:ell|ells|old|elling)\b", "predict"),
    "learnt": (r"\blearnt\b", "learned"),
    "mend": (r"\bmend(?:s|ed|ing)?\b", "fix"),
    "of-others": (r"\bof others\b|\bof one's own\b|\bothers'(?!\w)", "third-party; your own"),
    "rock": (r"\brocks?\b", "crustal field, crustal anomaly"),
    "lie": (
        r"\b(?:mass|masses|telemetry|sensor)(?:'s telemetry)? (?:that )?lies?\b|\bliars?\b",
        "wrong, inconsistent, spoofed",
    ),
    "doubt": (r"\bdoubt(?:s|ed|ing)?\b", "alarm, unexplained residual, suspected fault"),
    "apart": (
        r"\b(?:tell|tells|told) (?:\w+ )?(?:apart|from)\b|(?<!\d [a-zµ]m )(?<!\d ms )(?<!\d m )\bapart\b",
        "distinguish; separate; difference",
    ),
    "alike": (r"\balike\b", "correlated; equal; similar"),
    "what-is": (
        r"\b[Ww]hat (?:is|was|were|has|had|comes|came|becomes|moves|follows|it|no|others)\b(?![^.]*\?)",
        "name the thing: 'the learned calibration', not 'what is learned'",
    ),
    "who": (
        r"\bwho(?:ever)? (?:knows?|takes?|climbs|looks|puts|sends?)\b|\b[Ww]hoever\b",
        "users who; a program that",
    ),
    "such-as-one": (
        r"\bis such an? one\b|\b[Ss]o (?:is|are|do|does|was|were) (?:that|the|a|an|it|those)\b",
        "write it in full",
    ),
    "let": (
        r"^\s*(?:Let|Say|Tell|Whether|Take)\b (?!a |one )|\blets? expect\b",
        "the verb of the action: set, allow, predict; 'Return True if ...'",
    ),
    "speak": (r"\b(?:speaks?|hears?|heeds?)\b", "sends, receives, handles"),
    "settle": (r"\bsettle[sd]?\b|\bcome to rest\b", "converge (solver), resolve (alarm)"),
    "flown": (r"\b(?:was|were|is|are|not|be|been) flown (?:again|once|before|since)\b", "run, simulated"),
    "take-note": (r"\btakes? note\b|\btaken? (?:in|up|off|out)\b", "record, include, subtract, remove"),
    "by-chance": (r"\bbeyond chance\b", "statistically significant, with the threshold"),
    "room": (r"\brooms?\b(?! for| temperature)|\bthe house\b", "package, layer"),
    "nats": (r"\bnats\b", "log-likelihood ratio of N (natural log)"),
    "honest": (r"\bhonest(?:ly)?\b", "consistent (normalised error near 1)"),
    "opens-of": (
        r"(?:^|[.:] )Of (?:a|an|the|what|which|those|such|drones|others|several|channels)\b",
        "start with the subject",
    ),
    "unit-only": (r"^(?:nT|m|s|µs|Hz|deg|h|kB/s)(?:, .{0,25})?\.$", "the quantity, then its unit"),
    "same": (
        r"^(?:The same|As given|As above|That one|The one|One of them|Of the|Of what)\b",
        "repeat the noun",
    ),
}
NUMBER = re.compile(r"(?<![\w`./:-])[-−]?\d[\d,.]*")


class Finding(NamedTuple):
    """Violation of a rule: line, rule, text around it, and advice."""

    line: int
    rule: str
    text: str
    advice: str


def check(path: Path) -> tuple[int, list[Finding]]:
    """Return the number of words of a file's prose and the findings in it."""
    text = path.read_text(encoding="utf-8")
    is_page = path.suffix == ".md"
    words, findings = 0, []
    for line, sentence in set(_page(text) if is_page else _code(text)):
        words += len(sentence.split())
        for rule, (pattern, advice) in RULES.items():
            hits = re.finditer(pattern, sentence, flags=re.MULTILINE)
            contexts = [sentence[max(0, hit.start() - 30) : hit.end() + 30] for hit in hits]
            findings += [Finding(line, rule, context, advice) for context in contexts]
        if is_page:
            findings += _lengths(line, sentence)
    return words, sorted(findings)


def _lengths(line: int, sentence: str) -> Iterator[Finding]:
    """Yield the findings about the length of a page's sentence and the numbers in it."""
    if len(sentence.split()) > MAX_SENTENCE_WORDS:
        advice = f"{len(sentence.split())} words: at most {MAX_SENTENCE_WORDS}"
        yield Finding(line, "long", sentence[:60], advice)
    if len(NUMBER.findall(sentence)) > MAX_SENTENCE_NUMBERS:
        yield Finding(line, "numbers", sentence[:60], "put the numbers in a table")


def _page(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each sentence of a page, without code blocks, tables and headings."""
    text = re.sub(
        r"```.*?```|<!--.*?-->", lambda block: "\n" * block.group().count("\n"), text, flags=re.DOTALL
    )
    start, paragraph = 1, ""
    for number, line in enumerate([*text.split("\n"), ""], 1):
        is_item = re.match(r"\s*(?:[-*+]|\d+\.|:)\s+", line)
        if not line.strip() or is_item or re.match(r"\s*[|#!<]", line):
            yield from _sentences(start, paragraph)
            start, paragraph = number, line[is_item.end() :] if is_item else ""
        else:
            start = start if paragraph else number
            paragraph += " " + line.strip()


def _sentences(line: int, text: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each sentence of a paragraph, with code as one word and links as text."""
    text = re.sub(r"`[^`]*`", "CODE", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)).replace("**", "")
    for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z(\"'*])", text):
        if sentence.strip():
            yield line, sentence.strip()


def _code(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each sentence in docstrings, attribute docstrings, comments and messages."""
    nodes = list(ast.walk(ast.parse(text)))
    documentation = {id(node.value): node.lineno for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
            continue
        if id(node) in documentation:
            for paragraph in re.split(r"\n\s*\n", node.value):
                yield from _sentences(node.lineno, " ".join(paragraph.split()))
        elif node.value.count(" ") > 2:
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and "noqa" not in token.string:
            yield token.start[0], token.string.lstrip("# ")


def files_of(paths: list[Path]) -> list[Path]:
    """Return the Markdown pages and Python modules among the paths and in their folders."""
    found: list[Path] = []
    for path in paths:
        found += [path] if path.is_file() else (p for p in path.rglob("*") if p.suffix in {".md", ".py"})
    return sorted(found)


def checkout() -> list[Path]:
    """Return the Markdown pages and Python modules of the checkout, without generated and quoted files."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "*.md", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.split()
    except (OSError, subprocess.CalledProcessError):  # an unpacked archive
        listed = [str(path.relative_to(ROOT)) for path in files_of([ROOT]) if ".venv" not in path.parts]
    skipped = (*GENERATED, *QUOTED)
    return [ROOT / name for name in listed if name not in skipped and (ROOT / name).is_file()]


def areas(limits: dict[str, float]) -> dict[str, tuple[int, int]]:
    """Return (findings, words) of each area of the checkout."""
    counts: dict[str, tuple[int, int]] = defaultdict(lambda: (0, 0))
    for path in checkout():
        name = path.relative_to(ROOT).as_posix()
        matches = [area for area in limits if name == area or name.startswith(area + "/")]
        folder = "/".join(name.split("/")[:2]) if name.startswith("magbridge/") else name.split("/")[0]
        area = max(matches, key=len, default=folder)
        words, findings = check(path)
        before = counts[area]
        counts[area] = before[0] + len(findings), before[1] + words
    return dict(sorted(counts.items()))


def compare(*, verbose: bool) -> int:
    """Print the areas above their limit, or all areas if `verbose`; return 1 if an area is above."""
    limits = tomllib.loads(LIMITS.read_text(encoding="utf-8"))["prose"]
    over = 0
    for area, (findings, words) in areas(limits).items():
        rate, limit = 1000 * findings / max(words, 1), limits.get(area, limits["default"])
        is_over = rate > limit and findings > 1
        over += is_over
        if verbose or is_over:
            print(f"{area:32} {findings:5} in {words:7,} words: {rate:5.1f} per 1,000, at most {limit:.1f}")
    if over:
        print("\nprose: see each finding with: python tools/prose.py PATH")
    return int(over > 0)


def main() -> int:
    """Run the check; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--gate", action="store_true")
    parser.add_argument("--areas", action="store_true")
    options = parser.parse_args()
    if options.gate or options.areas:
        return compare(verbose=options.areas)
    total = words = 0
    for path in files_of(options.paths):
        count, findings = check(path)
        for line, rule, text, advice in findings:
            print(f"{path}:{line}: {rule}: …{text}… -> {advice}")
        total, words = total + len(findings), words + count
    print(
        f"{total} findings in {words:,} words: {1000 * total / max(words, 1):.1f} per 1,000", file=sys.stderr
    )
    return int(total > 0)


if __name__ == "__main__":
    sys.exit(main())
