"""Old names work for one release, and say what the new one is."""

import pytest

from magbridge.calibration.model import Calibration
from magbridge.deprecated import old_argument
from magbridge.diagnose.diagnosis import Finding


@pytest.mark.parametrize(
    ("kind", "old", "new"),
    [(Calibration, "doubts", "warnings"), (Finding, "gain", "improvement"), (Finding, "rivals", "competing")],
)
def test_an_old_attribute_is_the_new_one(kind: type, old: str, new: str) -> None:
    made: object = object.__new__(kind)
    object.__setattr__(made, new, ("here",))
    with pytest.warns(DeprecationWarning, match=f"'{old}' is now called '{new}'"):
        assert getattr(made, old) == ("here",)


def test_an_old_argument_is_the_new_one() -> None:
    @old_argument("length", "size")
    def twice(size: int) -> int:
        return 2 * size

    with pytest.warns(DeprecationWarning, match="'length' is now called 'size'"):
        assert twice(length=3) == 6  # type: ignore[call-arg]
    assert twice(size=3) == 6
