"""The registry: where footage is looked for, and what happens when a download goes wrong.

Downloads are real, from a server of the test's own on 127.0.0.1.
"""

import gc
import hashlib
import http.server
import io
import re
import socket
import threading
import zipfile
from importlib import resources

import cv2
import numpy as np
import pytest

from pftrack import datasets
from pftrack.datasets import registry

# pooch does not close the answer of a server that failed; see the fixture `server`
pytestmark = pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")

FETCHED = ("bobot-I", "bobot-J", "pets09-s2l1", "tud-campus", "caviar-walk1")
UNPUBLISHED = ("li-2012-hall", "li-2012-square", "li-2016-dynamic-background")


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def archive(members: dict[str, bytes], compression=zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return buffer.getvalue()


class Server(http.server.ThreadingHTTPServer):
    """Serves the bytes of `pages`; what is in `announced` claims that length instead of its own."""

    def __init__(self):
        self.pages, self.announced, self.requests = {}, {}, []
        super().__init__(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server_port}"


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        path = self.path.lstrip("/")
        self.server.requests.append(path)
        if path not in self.server.pages:
            self.send_error(404)
            return
        body = self.server.pages[path]
        self.send_response(200)
        self.send_header("Content-Length", str(self.server.announced.get(path, len(body))))
        self.end_headers()
        self.wfile.write(body)
        self.close_connection = True

    def log_message(self, *_):
        pass


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache, and no folder of the user's own."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(registry, "cache_folder", lambda: folder)
    monkeypatch.delenv("PFTRACK_DATA", raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    return folder


@pytest.fixture
def server():
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()
    gc.collect()  # close abandoned sockets here, where their warning is expected, and not in a later test


def files_in(folder) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())


# ---------------------------------------------------------------------------------------------------------------------
# What is in it
# ---------------------------------------------------------------------------------------------------------------------


def test_ids_are_unique_and_entries_stand_under_their_own():
    ids = datasets.ids()
    assert len(ids) == len(set(ids))
    assert all(entry.id == id for id, entry in registry.ENTRIES.items())
    assert {*FETCHED, *UNPUBLISHED, "caviar-corridor", "tud-stadtmitte", "synthetic-walk"} <= set(ids)
    assert all(entry.licence and entry.citation and entry.title for entry in registry.ENTRIES.values())


@pytest.mark.parametrize("id", FETCHED)
def test_checksums_are_listed_in_the_format_of_sha256sum(id):
    lines = (resources.files("pftrack.datasets") / "checksums" / f"{id}.txt").read_text().splitlines()
    listed = dict(re.fullmatch(r"([0-9a-f]{64}) [ *](\S.*)", line).groups()[::-1] for line in lines)
    assert len(listed) == len(lines)
    assert not any(path.startswith(("/", "../")) for path in listed)
    assert registry.ENTRIES[id].checksums == listed


@pytest.mark.parametrize("id", FETCHED)
def test_what_the_disk_holds_is_what_is_listed(id, footage, monkeypatch):
    monkeypatch.undo()  # the user's own folders
    sequence = footage(id)
    files, missing = registry.locate(id)
    assert missing == []
    checked = [path for path in files if not path.startswith("frames/")]
    checked += [path for path in files if path.startswith("frames/")][:3]
    for path in checked:
        assert sha256(files[path].read_bytes()) == registry.ENTRIES[id].checksums[path]
    assert sequence.name == id


@pytest.mark.parametrize("id", FETCHED)
def test_every_listed_file_has_a_pinned_address_or_instructions(id):
    entry = registry.ENTRIES[id]
    for path in entry.checksums:
        addresses = [url for pattern, url in entry.sources.items() if re.fullmatch(pattern.replace("*", ".*"), path)]
        assert addresses or entry.manual
        for address in addresses:
            assert address.startswith("https://")
            pinned = re.search(r"githubusercontent\.com/[^/]+/[^/]+/([0-9a-f]{40}|\d+\.\d+\.\d+)/", address)
            assert pinned or "githubusercontent" not in address


@pytest.mark.parametrize("id", UNPUBLISHED)
def test_footage_that_was_never_published_says_so(id):
    with pytest.raises(FileNotFoundError, match=f"{id} .*never published"):
        datasets.load(id)
    assert registry.locate(id)[1]


@pytest.mark.parametrize("call", [registry.entry, registry.locate, registry.fetch, datasets.load])
def test_an_unknown_id_is_answered_with_the_known_ones(call):
    with pytest.raises(ValueError, match=r"unknown dataset 'bobot-Z'.*bobot-I, bobot-J"):
        call("bobot-Z")


def test_the_cache_is_one_folder_of_the_users_own(monkeypatch):
    monkeypatch.undo()
    assert registry.cache_folder().name == "pftrack"
    assert registry.cache_folder().is_absolute()


# ---------------------------------------------------------------------------------------------------------------------
# Where files are looked for
# ---------------------------------------------------------------------------------------------------------------------


def put_file(folder, content=b"content"):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "a.bin").write_bytes(content)
    return folder / "a.bin"


def test_the_users_folder_goes_before_the_cache_and_the_cache_before_the_system(tmp_path, cache, monkeypatch, publish):
    system = put_file(tmp_path / "system")
    publish({}, {"a.bin": sha256(b"content")}, system={"a.bin": str(system)})
    monkeypatch.setenv("PFTRACK_DATA", str(tmp_path / "own"))
    assert registry.locate("fake") == ({"a.bin": system}, [])
    cached = put_file(cache / "fake")
    assert registry.locate("fake") == ({"a.bin": cached}, [])
    own = put_file(tmp_path / "own" / "fake")
    assert registry.locate("fake") == ({"a.bin": own}, [])
    monkeypatch.delenv("PFTRACK_DATA")
    assert registry.locate("fake") == ({"a.bin": cached}, [])


def test_what_is_nowhere_is_missing(publish):
    publish({}, {"a.bin": "0" * 64, "frames/b.jpg": "0" * 64}, system={"a.bin": "/nowhere/a.bin"})
    assert registry.locate("fake") == ({}, ["a.bin", "frames/b.jpg"])


@pytest.mark.parametrize("value", ["", "~/footage"])
def test_an_empty_variable_names_no_folder_and_a_tilde_is_home(tmp_path, cache, monkeypatch, publish, value):
    publish({}, {"a.bin": "0" * 64})
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PFTRACK_DATA", value)
    monkeypatch.chdir(tmp_path)
    place = put_file(tmp_path / "footage" / "fake" if value else cache / "fake")
    assert registry.locate("fake") == ({"a.bin": place}, [])


def test_files_that_are_here_are_not_asked_of_any_server(tmp_path, monkeypatch, publish, server):
    publish({"*": f"{server.address}/{{name}}"}, {"a.bin": sha256(b"content")})
    place = put_file(tmp_path / "own" / "fake")
    monkeypatch.setenv("PFTRACK_DATA", str(tmp_path / "own"))
    assert registry.fetch("fake") == {"a.bin": place}
    assert server.requests == []


# ---------------------------------------------------------------------------------------------------------------------
# Downloads
# ---------------------------------------------------------------------------------------------------------------------

CONTENT = bytes(range(256)) * 40


def test_a_download_is_complete_and_happens_once(cache, publish, server, capfd):
    server.pages = {"a.bin": CONTENT, "b.bin": b"other"}
    publish({"*": f"{server.address}/{{name}}"}, {"a.bin": sha256(CONTENT), "deep/b.bin": sha256(b"other")})
    expected = {"a.bin": cache / "fake" / "a.bin", "deep/b.bin": cache / "fake" / "deep" / "b.bin"}
    assert registry.fetch("fake", progress=False) == expected
    assert expected["a.bin"].read_bytes() == CONTENT
    assert expected["deep/b.bin"].read_bytes() == b"other"
    assert datasets.load("fake", progress=False) == expected
    assert server.requests == ["a.bin", "b.bin"]
    assert files_in(cache) == ["fake/a.bin", "fake/deep/b.bin"]
    assert capfd.readouterr() == ("", "")


def closed_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}"


@pytest.mark.parametrize(
    ("case", "kind"),
    [
        ("wrong content", ValueError),
        ("truncated", FileNotFoundError),
        ("not found", FileNotFoundError),
        ("server gone", FileNotFoundError),
    ],
)
def test_a_failed_download_is_one_clear_error_and_leaves_nothing(cache, publish, server, case, kind):
    if case != "not found":
        server.pages["a.bin"] = CONTENT[:-1]
    if case == "truncated":
        server.announced["a.bin"] = len(CONTENT)
    address = closed_port() if case == "server gone" else server.address
    publish({"*": f"{address}/{{name}}"}, {"a.bin": sha256(CONTENT)})
    with pytest.raises(kind) as error:
        registry.fetch("fake", progress=False)
    message = str(error.value)
    assert "a.bin" in message
    assert f"{address}/a.bin" in message
    assert "\n" not in message
    if kind is FileNotFoundError:
        assert "set PFTRACK_DATA" in message
    assert files_in(cache) == []


def test_an_interrupted_fetch_goes_on_where_it_stopped(cache, publish, server):
    names = ("a.bin", "b.bin", "c.bin")
    server.pages = {"a.bin": b"a", "b.bin": b"b"}
    publish({"*": f"{server.address}/{{name}}"}, {name: sha256(name[:1].encode()) for name in names})
    with pytest.raises(FileNotFoundError, match=r"c\.bin is not in"):
        registry.fetch("fake", progress=False)
    assert files_in(cache) == ["fake/a.bin", "fake/b.bin"]
    assert registry.locate("fake")[1] == ["c.bin"]
    server.pages["c.bin"] = b"c"
    assert sorted(registry.fetch("fake", progress=False)) == list(names)
    assert server.requests == ["a.bin", "b.bin", "c.bin", "c.bin"]


def test_a_damaged_download_can_be_tried_again(cache, publish, server):
    server.pages["a.bin"] = CONTENT[:-1]
    publish({"*": f"{server.address}/{{name}}"}, {"a.bin": sha256(CONTENT)})
    with pytest.raises(ValueError, match=r"a\.bin"):
        registry.fetch("fake", progress=False)
    server.pages["a.bin"] = CONTENT
    assert registry.fetch("fake", progress=False)["a.bin"].read_bytes() == CONTENT


def test_a_file_without_an_address_comes_with_instructions(publish, monkeypatch, tmp_path):
    publish({}, {"a.bin": "0" * 64}, manual="write a letter to the authors")
    with pytest.raises(FileNotFoundError, match=r"a\.bin is not in .*write a letter to the authors.* PFTRACK_DATA"):
        registry.fetch("fake", progress=False)


def test_a_progress_bar_is_shown_when_asked_for(publish, server, capfd):
    server.pages["a.bin"] = CONTENT
    publish({"*": f"{server.address}/{{name}}"}, {"a.bin": sha256(CONTENT)})
    registry.fetch("fake", progress=True)
    assert "1/1" in capfd.readouterr().err


# ---------------------------------------------------------------------------------------------------------------------
# Archives
# ---------------------------------------------------------------------------------------------------------------------

TEXT = b"0 0.1 0.1 0.1 0.1\n" * 100


def test_files_come_out_of_an_archive_wherever_they_lie_in_it(cache, publish, server):
    server.pages["film.zip"] = archive({"film/a.txt": TEXT, "film/readme": b"hello", "b.txt": b"b"})
    publish({"*": f"{server.address}/film.zip"}, {"a.txt": sha256(TEXT), "b.txt": sha256(b"b")})
    files = registry.fetch("fake", progress=False)
    assert files == {"a.txt": cache / "fake" / "a.txt", "b.txt": cache / "fake" / "b.txt"}
    assert files["a.txt"].read_bytes() == TEXT
    assert files_in(cache) == ["fake/a.txt", "fake/b.txt"]
    assert server.requests == ["film.zip"]


def test_a_file_of_an_archive_may_have_its_place_in_a_folder(cache, publish, server):
    server.pages["film.zip"] = archive({"film/0001.jpg": b"picture"})
    publish({"*": f"{server.address}/film.zip"}, {"frames/0001.jpg": sha256(b"picture")})
    assert registry.fetch("fake", progress=False) == {"frames/0001.jpg": cache / "fake" / "frames" / "0001.jpg"}


@pytest.mark.parametrize("names", [("a.txt", "b.txt"), ("b.txt", "a.txt")], ids=["archive first", "archive last"])
def test_an_archive_need_not_hold_what_has_another_address(publish, server, names):
    server.pages = {"film.zip": archive({"a.txt": TEXT}), "b.txt": b"b"}
    contents = {"a.txt": TEXT, "b.txt": b"b"}
    publish(
        {"b.txt": f"{server.address}/b.txt", "*": f"{server.address}/film.zip"},
        {name: sha256(contents[name]) for name in names},
    )
    files = registry.fetch("fake", progress=False)
    assert {name: path.read_bytes() for name, path in files.items()} == contents


def damaged(case: str) -> bytes:
    good = archive({"a.txt": TEXT})
    begin = 30 + len("a.txt")  # the compressed data follow the local header and the name
    if case == "cut short":
        return good[: len(good) // 2]
    if case == "a web page":
        return b"<html>Sign in first</html>"
    if case == "another archive":
        return archive({"b.txt": TEXT})
    if case == "other content":
        return archive({"a.txt": TEXT[:-1]})
    if case == "broken compression":  # a deflate block of type 3 does not exist
        return good[:begin] + b"\xff" * 8 + good[begin + 8 :]
    if case == "a flipped byte":
        good = archive({"a.txt": TEXT}, zipfile.ZIP_STORED)
        return good[: begin + 5] + bytes([good[begin + 5] ^ 1]) + good[begin + 6 :]
    if case == "of a future version":
        place = good.index(b"PK\x01\x02") + 6
        return good[:place] + b"\xff" + good[place + 1 :]
    raise AssertionError(case)


@pytest.mark.parametrize(
    "case",
    [
        "cut short",
        "a web page",
        "another archive",
        "other content",
        "broken compression",
        "a flipped byte",
        "of a future version",
    ],
)
def test_a_damaged_archive_is_one_clear_error_and_leaves_nothing(cache, publish, server, case):
    server.pages["film.zip"] = damaged(case)
    publish({"*": f"{server.address}/film.zip"}, {"a.txt": sha256(TEXT)})
    with pytest.raises(ValueError, match=r"again|incomplete|damaged") as error:
        registry.fetch("fake", progress=False)
    assert f"{server.address}/film.zip" in str(error.value)
    assert "\n" not in str(error.value)
    assert files_in(cache) == []


@pytest.mark.parametrize("case", ["truncated", "not found", "server gone"])
def test_an_archive_that_does_not_arrive_leaves_nothing(cache, publish, server, case):
    if case == "truncated":
        server.pages["film.zip"] = archive({"a.txt": TEXT})
        server.announced["film.zip"] = 10**5
    address = closed_port() if case == "server gone" else server.address
    publish({"*": f"{address}/film.zip"}, {"a.txt": sha256(TEXT)})
    with pytest.raises(FileNotFoundError, match=rf"a\.txt.*{address}/film\.zip.*PFTRACK_DATA"):
        registry.fetch("fake", progress=False)
    assert files_in(cache) == []


# ---------------------------------------------------------------------------------------------------------------------
# Footage that is put in place by hand
# ---------------------------------------------------------------------------------------------------------------------

CAVIAR_FRAME = (
    '<frame number="{n}"><objectlist><object id="1"><box h="40" w="20" xc="{x}" yc="50"/></object></objectlist></frame>'
)
CAVIAR = "<dataset>" + "".join(CAVIAR_FRAME.format(n=n, x=100 + n) for n in range(20)) + "</dataset>"


@pytest.fixture
def by_hand(tmp_path, monkeypatch):
    """Return a function that makes a folder of frames for an id and returns it."""
    monkeypatch.setenv("PFTRACK_DATA", str(tmp_path))

    def make(id, names):
        (tmp_path / id / "frames").mkdir(parents=True)
        for n, name in enumerate(names):
            cv2.imwrite(str(tmp_path / id / "frames" / name), np.full((16, 24, 3), 10 * n, np.uint8))
        return tmp_path / id

    return make


@pytest.mark.parametrize(
    ("id", "hint"),
    [
        ("caviar-corridor", "download the JPEG frames and the XML truth"),
        ("tud-stadtmitte", "download TUD-Stadtmitte from https://motchallenge.net"),
    ],
)
def test_footage_to_be_fetched_by_hand_says_how(cache, id, hint):
    with pytest.raises(FileNotFoundError, match=f"{id}.*cannot be downloaded.*{hint}.*PFTRACK_DATA"):
        datasets.load(id, progress=False)


def test_caviar_frames_are_asked_for_by_hand_when_the_truth_is_here(by_hand):
    folder = by_hand("caviar-walk1", [])
    (folder / "wk1gt.xml").write_text(CAVIAR)
    with pytest.raises(FileNotFoundError, match=r"Walk10236\.jpg is not in.*download the JPEG frames.*PFTRACK_DATA"):
        datasets.load("caviar-walk1", progress=False)


def test_caviar_truth_is_counted_from_the_first_frame_that_is_here(by_hand):
    folder = by_hand("caviar-corridor", [f"Corridor{n:04}.jpg" for n in range(5, 9)])
    (folder / "truth.xml").write_text(CAVIAR)
    sequence = datasets.load("caviar-corridor")
    assert len(sequence) == 4
    np.testing.assert_array_equal(sequence.boxes, [[100 + n - 10, 30, 20, 40] for n in range(5, 9)])
    assert abs(int(sequence.frames[3].mean()) - 30) <= 1


def test_caviar_frames_with_a_gap_are_refused(by_hand):
    folder = by_hand("caviar-corridor", ["Corridor0005.jpg", "Corridor0007.jpg"])
    (folder / "truth.xml").write_text(CAVIAR)
    with pytest.raises(ValueError, match="caviar-corridor are not numbered without gaps"):
        datasets.load("caviar-corridor")


@pytest.mark.parametrize("with_detections", [False, True])
def test_tud_is_read_with_and_without_detections(by_hand, with_detections):
    folder = by_hand("tud-stadtmitte", ["000001.jpg", "000002.jpg"])
    (folder / "gt.txt").write_text("1,1,1,2,3,4,1\n2,1,2,2,3,4,1\n")
    if with_detections:
        (folder / "det.txt").write_text("2,-1,2,2,3,4,0.5\n")
    sequence = datasets.load("tud-stadtmitte")
    np.testing.assert_array_equal(sequence.boxes, [[1, 2, 3, 4], [2, 2, 3, 4]])
    assert (sequence.detections is not None) == with_detections


def test_a_stray_file_among_the_frames_is_not_a_frame(by_hand):
    folder = by_hand("tud-stadtmitte", ["000001.jpg", "000002.jpg"])
    (folder / "frames" / "Thumbs.db").write_bytes(b"left by a file manager")
    (folder / "gt.txt").write_text("1,1,1,2,3,4,1\n")
    assert len(datasets.load("tud-stadtmitte").frames) == 2


@pytest.mark.parametrize("id", ["caviar-corridor", "tud-stadtmitte"])
def test_frames_without_their_truth_are_one_clear_error(by_hand, id):
    by_hand(id, ["frame0001.jpg"])
    with pytest.raises((FileNotFoundError, ValueError), match=f"{id}.*(truth|gt)"):
        datasets.load(id, progress=False)


# ---------------------------------------------------------------------------------------------------------------------
# Digests
# ---------------------------------------------------------------------------------------------------------------------


def test_check_digest_accepts_the_right_file_and_names_the_wrong_one(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"abc")
    right = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, appendix B.1
    registry.check_digest(tmp_path / "a.bin", right)
    with pytest.raises(ValueError, match=r"a\.bin has the wrong SHA-256.*fetch it again"):
        registry.check_digest(tmp_path / "a.bin", right[::-1])
