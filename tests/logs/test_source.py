"""What a log says it was made from."""

from __future__ import annotations

from pathlib import Path

from magbridge import logs
from magbridge.logs.deployment import deployment


def test_a_log_rewritten_again_and_again_names_itself_and_where_it_began(tmp_path: Path) -> None:
    logs.write(deployment("comet, driven by (old) p.nc", [1.0], {}), tmp_path / "a.nc")
    logs.write(logs.read(tmp_path / "a.nc"), tmp_path / "ba.nc")
    logs.write(logs.read(tmp_path / "ba.nc"), tmp_path / "c.parquet")
    assert logs.read(tmp_path / "c.parquet").attrs["source"] == "c.parquet (comet, driven by (old) p.nc)"
    (tmp_path / "a.nc").unlink()
    (tmp_path / "ba.nc").rename(tmp_path / "a.nc")  # within the other's name
    assert logs.read(tmp_path / "a.nc").attrs["source"] == "a.nc (comet, driven by (old) p.nc)"


def test_a_log_rewritten_from_several_names_them_all(tmp_path: Path) -> None:
    for k, name in enumerate("ab"):
        logs.write(deployment("comet, driven by p.nc", [float(k)], {}), tmp_path / f"{name}.nc")
    both = "a.nc (comet, driven by p.nc), b.nc (comet, driven by p.nc)"
    whole = logs.read([tmp_path / "a.nc", tmp_path / "b.nc"])
    assert whole.attrs["source"] == both
    logs.write(whole, tmp_path / "c.nc")
    logs.write(logs.read(tmp_path / "c.nc"), tmp_path / "d.nc")
    assert logs.read(tmp_path / "d.nc").attrs["source"] == f"d.nc ({both})"
