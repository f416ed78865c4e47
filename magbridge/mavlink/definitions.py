"""The dialect as other programs take it: XML with all that it includes, and modules for pymavlink."""

from __future__ import annotations

import shutil
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from magbridge.errors import DataError

__all__ = ["write_definitions"]

DIALECT_XML = Path(__file__).with_name("magbridge.xml")
WITH_ARDUPILOT = "magbridge_ardupilotmega.xml"
"""For stations of ArduPilot, whose own messages are more than the common ones."""
DIALECTS = {DIALECT_XML.name: "magbridge_dialect.py", WITH_ARDUPILOT: "magbridge_ardupilotmega.py"}
"""The XML of each dialect, and its module; a module named magbridge would hide the package."""
BOTH = """<?xml version="1.0"?>
<!-- ArduPilot's messages and those of magbridge. -->
<mavlink>
  <include>ardupilotmega.xml</include>
  <include>magbridge.xml</include>
  <dialect>0</dialect>
</mavlink>
"""


def write_definitions(folder: Path) -> list[Path]:
    """Write the XML of the dialect and of its includes, and a module for pymavlink of each dialect.

    `folder`: it exists; files of these names in it are replaced.
    Returns the dialects' XML and modules, without the included ones.
    ImportError: pymavlink, which has the standard definitions and makes the modules, is not installed.
    DataError: its generator made no module.
    """
    import pymavlink  # noqa: PLC0415 - the generator takes long to import
    from pymavlink.generator import mavgen, mavparse  # noqa: PLC0415

    shipped = Path(pymavlink.__file__).parent / "dialects" / "v20"
    shutil.copyfile(DIALECT_XML, folder / DIALECT_XML.name)
    (folder / WITH_ARDUPILOT).write_text(BOTH, encoding="utf-8")
    wanted = list(DIALECTS)
    for name in wanted:  # grows by what each includes
        if name not in DIALECTS:
            shutil.copyfile(shipped / name, folder / name)
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            included = mavparse.MAVXML(str(folder / name), mavparse.PROTOCOL_2_0).include
        wanted += [one for one in included if one not in wanted]
    written = []
    for name, module_name in DIALECTS.items():
        module = folder / module_name
        reported = StringIO()
        with (
            redirect_stdout(reported),
            redirect_stderr(reported),
        ):  # mavgen tells of every file that it looks at
            options = mavgen.Opts(str(module), wire_protocol="2.0", language="Python3", validate=False)
            done = mavgen.mavgen(options, [str(folder / name)])
        if not done or not module.exists():
            raise DataError(f"mavgen made no {module.name}: {reported.getvalue().strip()}")
        written += [folder / name, module]
    return written
