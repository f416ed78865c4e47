"""Test the service, the adapter's udev rule, the container and the BlueOS extension."""

import json
import re
import shutil
import subprocess
from configparser import ConfigParser
from pathlib import Path

import pytest

from magbridge.version import __version__

PACKAGING = Path(__file__).parents[1] / "tools" / "packaging"


class _Unit(ConfigParser):
    """A systemd unit: keys keep their capitals, and may be repeated."""

    def optionxform(self, optionstr: str) -> str:
        return optionstr


def test_the_service_runs_what_the_command_line_has() -> None:
    unit = _Unit(strict=False, interpolation=None)
    unit.read(PACKAGING / "magbridge.service")
    service = unit["Service"]
    assert re.fullmatch(r"/\S+/magbridge run --config /\S+\.toml", service["ExecStart"])
    assert service["RestartPreventExitStatus"] == "2"  # wrong use: the configuration
    assert service["SupplementaryGroups"] == "dialout"
    assert service["WorkingDirectory"] == f"/var/lib/{service['StateDirectory']}"
    assert service["ExecStart"].split()[-1].startswith(service["WorkingDirectory"])


def test_systemd_finds_nothing_wrong_with_the_service(tmp_path: Path) -> None:
    verify = shutil.which("systemd-analyze")
    if verify is None:
        pytest.skip("systemd-analyze is not installed")
    unit = tmp_path / "magbridge.service"
    text = (PACKAGING / "magbridge.service").read_text()
    unit.write_text(text.replace("/opt/magbridge/bin/magbridge", "/bin/true"))
    done = subprocess.run([verify, "verify", str(unit)], capture_output=True, text=True, check=False)
    assert not [line for line in done.stderr.splitlines() if "magbridge.service" in line]


MAX_EXPOSURE = 3.0
"""Maximum exposure of the service, of ten, by `systemd-analyze security`."""


def test_the_service_is_confined() -> None:
    analyse = shutil.which("systemd-analyze")
    if analyse is None:
        pytest.skip("systemd-analyze is not installed")
    command = [analyse, "security", "--offline=true", str(PACKAGING / "magbridge.service")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = re.search(r"exposure level for magbridge.service: ([\d.]+)", done.stdout)
    if found is None:
        pytest.skip(f"this systemd-analyze reads no files: {done.stderr.strip()[:100]}")
    assert float(found[1]) < MAX_EXPOSURE


def test_the_container_runs_unprivileged_from_the_lock_on_a_pinned_base() -> None:
    lines = (PACKAGING / "Containerfile").read_text(encoding="utf-8").splitlines()
    bases = [line.split()[1] for line in lines if line.startswith("FROM ")]
    assert all(re.fullmatch(r"python:3\.\d+\.\d+-slim-\w+", base) for base in bases), bases
    assert any("uv sync --locked" in line for line in lines)
    assert [line.split()[1] for line in lines if line.startswith("USER ")] == ["magbridge"]
    started = [json.loads(line.split(maxsplit=1)[1]) for line in lines if re.match("ENTRYPOINT|CMD", line)]
    assert started == [["magbridge"], ["run", "--config", "/data/bridge.toml"]]


def test_the_rule_names_each_adapter_once() -> None:
    lines = [
        line for line in (PACKAGING / "99-magbridge.rules").read_text().splitlines() if line[:1] not in "#"
    ]
    part = r'[A-Z]+(?:\{\w+\})?(?:==|\+=|=)"[^"]*"'
    assert all(re.fullmatch(rf"{part}(?:, {part})*", line) for line in lines)
    assert all('SYMLINK+="fluxgate"' in line and 'GROUP="dialout"' in line for line in lines)
    adapters = [re.findall(r'ATTRS\{id\w+\}=="(\w{4})"', line) for line in lines]
    assert all(len(one) == 2 for one in adapters)
    assert len({tuple(one) for one in adapters}) == len(lines)


def test_the_extension_has_the_labels_that_blueos_asks_for() -> None:
    text = (PACKAGING / "Containerfile").read_text()
    labels = re.findall(r"^LABEL (\w+)=(.*)$", text, re.MULTILINE)
    found = {name: value.strip("\"'") for name, value in labels}
    assert found["version"] == __version__
    assert found.keys() >= {"version", "permissions", "authors", "company", "readme", "links", "type", "tags"}
    assert json.loads(found["permissions"])["HostConfig"]["GroupAdd"] == ["dialout"]
    assert all(one["name"] for one in json.loads(found["authors"]))
    assert json.loads(found["company"]).keys() >= {"name", "about"}
    assert isinstance(json.loads(found["links"]), dict)
    assert re.fullmatch(r"https://raw\.githubusercontent\.com/\S+/\{tag\}/(\S+\.md)", found["readme"])
    assert (PACKAGING.parents[1] / found["readme"].split("{tag}/")[1]).is_file()
    entry = json.loads((PACKAGING / "blueos" / "metadata.json").read_text())
    assert entry.keys() == {"name", "website", "docker", "description"}
    assert all(entry.values())


def test_the_container_can_be_built() -> None:
    builders = [shutil.which(name) for name in ("docker", "podman", "buildah")]
    for build in filter(None, builders):
        if not subprocess.run([build, "info"], capture_output=True, check=False).returncode:
            command = [build, "build", "-f", str(PACKAGING / "Containerfile"), str(PACKAGING.parents[1])]
            subprocess.run(command, check=True, timeout=600)
            return
    pytest.skip("neither docker, podman nor buildah works here")
