"""Text of JSON files, against the standard library; names that no file can have."""

import os
import stat
from pathlib import Path

import pytest

from netkf.core.errors import WriteError
from netkf.runs.files import write_text


def test_a_name_that_no_file_can_have_is_a_write_error(tmp_path):
    with pytest.raises(WriteError, match="cannot write: Invalid argument"):
        write_text(tmp_path / "a\0b", "text")
    for name in ("", ".", "/"):
        with pytest.raises(WriteError, match="cannot write: Is a directory"):
            write_text(Path(name), "text")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize("place", ["page", "page.part"])
def test_what_is_no_file_of_its_own_is_not_replaced(tmp_path, place):
    """For root that would be /dev/null, for the whole machine."""
    path = tmp_path / place
    kinds = [lambda: os.mkfifo(path), lambda: path.symlink_to("elsewhere")]
    if os.geteuid() == 0:
        kinds.append(lambda: os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 3)))
    for make in kinds:
        try:
            make()
        except PermissionError:  # a container without device nodes
            continue
        kind = path.lstat().st_mode
        with pytest.raises(WriteError, match=r"it is a (pipe|link|device), not a file of its own"):
            write_text(tmp_path / "page", "text")
        assert path.lstat().st_mode == kind
        assert list(tmp_path.iterdir()) == [path]
        path.unlink()
