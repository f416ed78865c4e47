"""Parameters set over the link are kept on the disk, which the sensor must not wait for too often."""

from __future__ import annotations

from pathlib import Path

from small import START, small_bridge

from magbridge.bridge.events import StartEvent
from magbridge.bridge.run import SAVE_US, Keeper
from magbridge.bridge.run import load_state as kept
from magbridge.calibration.model import Parameter
from magbridge.config import load


def test_a_flood_of_parameters_is_kept_once_a_second(tmp_path: Path) -> None:
    pipeline = small_bridge(tmp_path, StartEvent(START), Parameter("battpos", "", -0.4, 0.6, 0.1, 0.5), [])
    keeper, file = Keeper(load(tmp_path / "bridge.toml")), tmp_path / "bridge.parameters.json"
    values = [2.0 + 0.125 * k for k in range(10)]
    on_disk = []
    for k, value in enumerate(values):
        assert pipeline.component.parameters.set("MB_GAP_FACTOR", value)
        keeper.look(pipeline, START + k * SAVE_US // 5)
        on_disk.append(kept(file).parameters["MB_GAP_FACTOR"])
    assert on_disk == 5 * [values[0]] + 5 * [values[5]]
    keeper.look(pipeline, START + 2 * SAVE_US)
    assert kept(file).parameters["MB_GAP_FACTOR"] == values[-1]
