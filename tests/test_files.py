"""Files are written whole or not at all."""

import pytest

from pftrack import files


@pytest.mark.parametrize("error", [ValueError, OSError, KeyboardInterrupt])
@pytest.mark.parametrize("before", ["old", None], ids=["over a file", "new"])
def test_replacing_keeps_the_old_file_after_an_error_and_leaves_no_other(tmp_path, error, before):
    path = tmp_path / "a.txt"
    if before:
        path.write_text(before)

    def interrupted():
        with files.replacing(path) as temporary:
            temporary.write_text("half")
            assert temporary.parent == tmp_path  # on the same disk, so that the renaming is one step
            raise error("stop")

    with pytest.raises(error, match="stop"):
        interrupted()
    assert [file.read_text() for file in tmp_path.iterdir()] == ([before] if before else [])


def test_until_the_block_ends_the_old_file_is_what_others_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with files.replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


def test_others_may_read_the_file(tmp_path):
    with files.replacing(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o644
