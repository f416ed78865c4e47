"""Export of the MAVLink dialect for other programs: XML files with their includes, and pymavlink modules."""

from __future__ import annotations

import shutil
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from magbridge.errors import DataError

__all__ = ["write_definitions"]

DIALECT_XML = Path(__file__).with_name("magbridge.xml")
WITH_ARDUPILOT = "magbridge_ardupilotmega.xml"
"""XML of the dialect with ArduPilot's messages in addition to the common ones, for its ground stations."""
DIALECTS = {DIALECT_XML.name: "magbridge_dialect.py", WITH_ARDUPILOT: "magbridge_ardupilotmega.py"}
"""XML file of each dialect -> its Python module; a module named magbridge would hide the package."""
BOTH = """<?xml version="1.0"?>
<!-- ArduPilot's messages and those of magbridge. -->
<mavlink>
  <include>ardupilotmega.xml</include>
  <include>magbridge.xml</include>
  <dialect>0</dialect>
</mavlink>
"""


def write_definitions(folder: Path) -> list[Path]:
    """Write the XML of each dialect and of its includes, and a pymavlink module of each dialect.

    `folder`: existing folder; existing files with the names of written files are replaced.
    Returns the paths of the dialects' XML files and modules, without the included XML files.
    ImportError: pymavlink, which contains the standard definitions and the generator, is not installed.
    DataError: pymavlink's generator wrote no module.
    """
    import pymavlink  # noqa: PLC0415 - the generator takes long to import
    from pymavlink.generator import mavgen, mavparse  # noqa: PLC0415

    shipped = Path(pymavlink.__file__).parent / "dialects" / "v20"
    shutil.copyfile(DIALECT_XML, folder / DIALECT_XML.name)
    (folder / WITH_ARDUPILOT).write_text(BOTH, encoding="utf-8")
    wanted = list(DIALECTS)
    for name in wanted:  # grows by the includes of each file
        if name not in DIALECTS:
            shutil.copyfile(shipped / name, folder / name)
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            included = mavparse.MAVXML(str(folder / name), mavparse.PROTOCOL_2_0).include
        wanted += [one for one in included if one not in wanted]
    written = []
    for name, module_name in DIALECTS.items():
        module = folder / module_name
        reported = StringIO()
        with redirect_stdout(reported), redirect_stderr(reported):  # mavgen prints every file that it reads
            options = mavgen.Opts(str(module), wire_protocol="2.0", language="Python3", validate=False)
            done = mavgen.mavgen(options, [str(folder / name)])
        if not done or not module.exists():
            raise DataError(f"mavgen made no {module.name}: {reported.getvalue().strip()}")
        written += [folder / name, module]
    return written
