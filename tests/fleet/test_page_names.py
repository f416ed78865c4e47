"""Names in a catalogue never form a path outside the folder of the pages."""

from pathlib import Path
from typing import Any, cast

import pytest

from magbridge.errors import WriteError
from magbridge.fleet.page import write_pages


@pytest.mark.parametrize("name", ["../escaped", "a\\b", ".hidden", "", "two\nlines"])
def test_a_name_that_is_a_path_is_refused_before_anything_is_written(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "pages"
    with pytest.raises(WriteError, match="expected a name without slashes"):
        write_pages({name: cast(Any, None)}, folder, {})
    assert not list(tmp_path.iterdir())
