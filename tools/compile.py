"""Build hook: the live path compiled by mypyc where there is a C compiler; where there is none, plain Python.

Both are the same code and give the same bits; compiled, a sample costs half the processor time. An editable
installation is never compiled, so that edits take effect.

The environment variable ``MAGBRIDGE_COMPILE`` may be ``never``, or ``always``: fail if it cannot be compiled.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SETUP = """
import sys
from mypyc.build import mypycify
from setuptools import setup
target, *modules = sys.argv.pop().split(",")
options = ["--ignore-missing-imports", "--follow-imports=silent", "--config-file="]
compiled = mypycify([*options, *modules], target_dir=target, opt_level="3")
setup(name="magbridge", packages=[], ext_modules=compiled)
"""
FLAGS = "-ffp-contract=off"
"""A fused multiply-add rounds once and not twice: a compiled bridge must give the bits that Python gives."""


class Compile(BuildHookInterface[Any]):
    """Puts compiled modules into the wheel, beside their sources."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the modules that ``pyproject.toml`` lists."""
        wish = os.environ.get("MAGBRIDGE_COMPILE", "")
        if version == "editable" or wish == "never":
            return
        self._folder = tempfile.TemporaryDirectory()
        target, built = Path(self._folder.name, "c"), Path(self._folder.name, "lib")
        modules = ",".join([str(target), *self.config["modules"]])
        place = ["build_ext", "--build-lib", str(built), "--build-temp", str(target / "o")]
        done = subprocess.run(
            [sys.executable, "-c", SETUP, *place, modules],
            cwd=self.root, env={**os.environ, "CFLAGS": FLAGS}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            if wish == "always":
                raise RuntimeError(f"the live path does not compile:\n{done.stdout}{done.stderr}")
            why = (done.stderr or done.stdout).strip().splitlines()[-1:]
            self.app.display_warning(f"not compiled, so twice the processor time a sample: {' '.join(why)}")
            return
        libraries = [path for path in built.rglob("*") if path.suffix in (".so", ".pyd")]
        build_data["force_include"].update({str(path): str(path.relative_to(built)) for path in libraries})
        build_data |= {"pure_python": False, "infer_tag": True}

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        """Remove the intermediate files."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()
