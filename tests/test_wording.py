"""Test words of messages that depend on a number."""

from magbridge.wording import counted


def test_a_noun_follows_its_count() -> None:
    assert [counted(n, "vehicle") for n in (0, 1, 2)] == ["0 vehicles", "1 vehicle", "2 vehicles"]
