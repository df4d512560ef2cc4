"""The pftrack command: what it writes, and that every error is one line, exit status 2 and no file.

Standard error is captured at the level of the system (capfd), since codecs and image libraries write there too.
"""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

import pftrack
from pftrack import datasets, metrics, multi, trackers
from pftrack.cli import main
from pftrack.datasets import readers, registry

N_FRAMES = 12
BOX = (10, 20, 16, 30)
TEXT = "10,20,16,30"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(pftrack.__file__).parents[1])}


def picture(n: int, size=(64, 96)) -> np.ndarray:
    """A two-coloured target on grey that moves by two pixels a frame."""
    frame = np.full((*size, 3), 120, dtype=np.uint8)
    x = 10 + 2 * n
    frame[20:35, x : x + 16] = (200, 40, 30)
    frame[35:50, x : x + 16] = (30, 160, 40)
    return frame


def write_folder(folder: Path, frames) -> Path:
    folder.mkdir()
    for n, frame in enumerate(frames):
        assert cv2.imwrite(str(folder / f"{n:03}.png"), frame)
    return folder


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A folder of images."""
    return write_folder(tmp_path_factory.mktemp("film") / "film", map(picture, range(N_FRAMES)))


@pytest.fixture(scope="module")
def movie(film):
    """The same film as a video at 10 frames a second."""
    path = film.parent / "film.mp4"
    pftrack.video.write(path, (picture(n) for n in range(N_FRAMES)), fps=10)
    return path


@pytest.fixture
def out(tmp_path):
    (tmp_path / "out").mkdir()
    return tmp_path / "out"


@pytest.fixture(autouse=True)
def quiet_footage(monkeypatch, request):
    """No folder of the user's own, but where a test asks for footage."""
    if "footage" not in request.fixturenames:
        monkeypatch.delenv("PFTRACK_DATA", raising=False)


def run(*arguments) -> int:
    """Exit status of the command, whichever way it leaves."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as error:
        return error.code


def read_rows(path) -> tuple[list[str], np.ndarray]:
    with Path(path).open(newline="") as file:
        head, *rows = csv.reader(file)
    return head, np.array([[float(word or "nan") for word in row] for row in rows])


def video_facts(path) -> dict:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return {
            "codec": stream.codec_context.name,
            "pixels": stream.codec_context.pix_fmt,
            "size": (stream.codec_context.height, stream.codec_context.width),
            "fps": float(stream.average_rate),
            "n_frames": sum(1 for _ in container.decode(video=0)),
        }


def one_line(capfd) -> str:
    """The single line on standard error; nothing may be on standard output."""
    captured = capfd.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("pftrack")
    assert "Traceback" not in captured.err
    assert captured.out == ""
    return lines[0]


def assert_matches(pattern: str, line: str) -> None:
    assert re.search(pattern, line), line


# ---------------------------------------------------------------------------------------------------------------------
# pftrack track
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "tracker"),
    [
        ([], trackers.ColorParticleFilter(n_particles=100, seed=0)),
        (["--tracker", "color-pf", "--particles", "30", "--seed", "7"], trackers.ColorParticleFilter(30, seed=7)),
        (["--tracker", "mean-shift"], trackers.MeanShiftTracker()),
        (["--tracker", "camshift"], trackers.CamShiftTracker()),
    ],
    ids=["default", "color-pf", "mean-shift", "camshift"],
)
@pytest.mark.parametrize("kind", ["folder", "video"])
def test_the_csv_holds_what_python_computes(film, movie, out, capfd, arguments, tracker, kind):
    source = film if kind == "folder" else movie
    assert run("track", source, "--box", TEXT, "--csv", out / "boxes.csv", *arguments) == 0
    head, rows = read_rows(out / "boxes.csv")
    assert head == ["frame", "x", "y", "w", "h", "score", "lost"]
    estimates = list(trackers.follow(tracker, datasets.open_frames(source), BOX))
    np.testing.assert_array_equal(rows[:, 0], np.arange(N_FRAMES))
    np.testing.assert_allclose(rows[:, 1:5], [estimate.box for estimate in estimates], atol=0.00051)
    np.testing.assert_allclose(rows[:, 5], [estimate.score for estimate in estimates], atol=0.000051)
    np.testing.assert_array_equal(rows[:, 6], [estimate.lost for estimate in estimates])
    captured = capfd.readouterr()
    assert captured.out == f"{N_FRAMES} frames, lost in {sum(estimate.lost for estimate in estimates)}\n"
    assert captured.err == ""
    assert [path.name for path in out.iterdir()] == ["boxes.csv"]


@pytest.mark.parametrize(("kind", "fps"), [("folder", 25), ("video", 10)])
def test_the_video_plays_in_a_browser_and_shows_the_box(film, movie, out, kind, fps):
    source = film if kind == "folder" else movie
    assert run("track", source, "--box", TEXT, "--video", out / "film.mp4") == 0
    facts = video_facts(out / "film.mp4")
    assert facts == {"codec": "h264", "pixels": "yuv420p", "size": (64, 96), "fps": fps, "n_frames": N_FRAMES}
    first = datasets.open_frames(out / "film.mp4")[0].astype(int)
    assert np.abs(first - picture(0))[18:22, 10:26].mean() > 30  # the upper edge of the box is drawn there
    assert np.abs(first - picture(0))[:10].mean() < 10
    assert [path.name for path in out.iterdir()] == ["film.mp4"]


def test_csv_and_video_of_one_run_agree(film, out):
    assert run("track", film, "--box", TEXT, "--csv", out / "a.csv", "--video", out / "a.mp4") == 0
    assert run("track", film, "--box", TEXT, "--csv", out / "b.csv") == 0
    assert (out / "a.csv").read_bytes() == (out / "b.csv").read_bytes()


def test_a_dataset_brings_its_first_box_with_it(out, capfd):
    assert run("track", "synthetic-walk", "--tracker", "mean-shift", "--csv", out / "boxes.csv") == 0
    scene = datasets.load("synthetic-walk")
    _, rows = read_rows(out / "boxes.csv")
    assert len(rows) == len(scene)
    np.testing.assert_array_equal(rows[0, 1:5], scene.boxes[0])
    assert capfd.readouterr().out.startswith("100 frames, lost in 0")


@pytest.mark.parametrize("id", ["bobot-J", "pets09-s2l1", "tud-campus", "caviar-walk1"])
def test_every_real_dataset_can_be_started_without_a_box(footage, id, monkeypatch, out):
    """Three frames of each are enough."""
    sequence = footage(id)
    first = datasets.Sequence(id, "", sequence.frames[:3], sequence.tracks, 25.0, "", "")
    monkeypatch.setattr(datasets, "load", lambda *_, **__: first)
    assert run("track", id, "--csv", out / "boxes.csv") == 0
    np.testing.assert_allclose(read_rows(out / "boxes.csv")[1][0, 1:5], sequence.boxes[0], atol=0.00051)


def test_a_given_box_goes_before_that_of_the_dataset(out):
    assert run("track", "synthetic-walk", "--box", "5,6,20,30", "--particles", "1", "--csv", out / "a.csv") == 0
    np.testing.assert_array_equal(read_rows(out / "a.csv")[1][0, 1:5], (5, 6, 20, 30))


@pytest.mark.parametrize("form", [["--box=-5,20,16,30"], ["--box", "-5,20,16,30"]], ids=["equals", "space"])
def test_a_box_over_the_left_border_can_be_given(film, capfd, form):
    assert run("track", film, *form) == 0


def test_without_output_files_the_summary_is_printed(film, capfd):
    assert run("track", film, "--box", TEXT) == 0
    assert capfd.readouterr() == (f"{N_FRAMES} frames, lost in 0\n", "")


def test_a_lost_target_is_marked_in_the_csv(tmp_path, out, capfd):
    frames = [picture(0), picture(1), np.zeros_like(picture(0)), np.zeros_like(picture(0))]
    folder = write_folder(tmp_path / "short", frames)
    assert run("track", folder, "--box", TEXT, "--tracker", "mean-shift", "--csv", out / "boxes.csv") == 0
    assert read_rows(out / "boxes.csv")[1][:, 6].tolist() == [0, 0, 1, 1]
    assert capfd.readouterr().out == "4 frames, lost in 2\n"


def test_frames_missing_at_the_end_of_a_film_are_lost_and_mentioned(tmp_path, out, capfd):
    path = tmp_path / "short.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, (96, 64))
    for n in range(20):
        writer.write(picture(n))
    writer.release()
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    command = ("track", path, "--box", TEXT, "--tracker", "mean-shift")
    assert run(*command, "--csv", out / "boxes.csv", "--video", out / "film.mp4") == 0
    _, rows = read_rows(out / "boxes.csv")
    n_read = int(np.isfinite(rows[:, 1]).sum())
    assert 1 < n_read < 20
    assert len(rows) == 20
    assert np.isnan(rows[n_read:, 1:5]).all()
    assert (rows[n_read:, 5] == 0).all()
    assert (rows[n_read:, 6] == 1).all()
    assert (out / "boxes.csv").read_text().endswith("\n19,,,,,0.0000,1\n")
    assert f"announces 20 frames but ends {20 - n_read} early" in capfd.readouterr().out
    assert video_facts(out / "film.mp4")["n_frames"] == n_read


# ---------------------------------------------------------------------------------------------------------------------
# Errors of pftrack track
# ---------------------------------------------------------------------------------------------------------------------


def damaged_jpeg(folder: Path) -> Path:
    return write_half_image(folder, ".jpg")


def damaged_png(folder: Path) -> Path:
    return write_half_image(folder, ".png")


def write_half_image(folder: Path, suffix: str) -> Path:
    write_folder(folder, [picture(0), picture(1)])
    noisy = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    data = cv2.imencode(suffix, noisy)[1].tobytes()
    (folder / f"002{suffix}").write_bytes(data[: len(data) // 2])
    return folder


def sized(folder: Path) -> Path:
    return write_folder(folder, [picture(0), picture(1), picture(2, size=(80, 100))])


def half_a_video(path: Path) -> Path:
    path = path.with_suffix(".mp4")
    pftrack.video.write(path, (picture(n) for n in range(N_FRAMES)), fps=10)
    path.write_bytes(path.read_bytes()[:700])
    return path


def a_text(path: Path) -> Path:
    path.write_text("this is no video " * 50)
    return path


def an_empty_file(path: Path) -> Path:
    path.touch()
    return path


def no_images(folder: Path) -> Path:
    folder.mkdir()
    (folder / "readme.txt").write_text("nothing here")
    return folder


BAD_SOURCES = {
    "missing": (lambda path: path, "no file, folder or dataset '.*source'; the datasets are bobot-I"),
    "text": (a_text, "source cannot be decoded as a video; it may be damaged"),
    "empty file": (an_empty_file, "source cannot be decoded as a video"),
    "half a video": (half_a_video, r"source\.mp4 cannot be decoded as a video"),
    "no images": (no_images, "source holds no images"),
    "damaged JPEG": (damaged_jpeg, r"002\.jpg cannot be decoded as an image; it may be damaged"),
    "damaged PNG": (damaged_png, r"002\.png cannot be decoded as an image; it may be damaged"),
    "another size": (sized, "frame 2: the frame is 100x80 but tracking began on 96x64"),
}


@pytest.mark.parametrize(("make", "hint"), BAD_SOURCES.values(), ids=BAD_SOURCES.keys())
def test_a_bad_source_is_one_line_and_leaves_nothing(tmp_path, out, capfd, make, hint):
    source = make(tmp_path / "source")
    capfd.readouterr()
    assert run("track", source, "--box", TEXT, "--csv", out / "a.csv", "--video", out / "a.mp4") == 2
    assert list(out.iterdir()) == []
    assert_matches(hint, one_line(capfd))


BAD_ARGUMENTS = {
    "no box": ([], "--box X,Y,W,H"),
    "three numbers": (["--box", "1,2,3"], "--box takes four numbers X,Y,W,H, got '1,2,3'"),
    "five numbers": (["--box", "1,2,3,4,5"], "--box takes four numbers X,Y,W,H"),
    "words": (["--box", "a,b,c,d"], "--box takes four numbers X,Y,W,H, got 'a,b,c,d'"),
    "no commas": (["--box", "1 2 3 4"], "--box takes four numbers X,Y,W,H"),
    "nothing after --box": (["--box"], "expected one argument"),
    "NaN box": (["--box", "nan,20,16,30"], "four finite numbers"),
    "infinite box": (["--box", "10,20,inf,30"], "four finite numbers"),
    "huge box": (["--box", "0,0,1e300,30"], "box"),
    "empty box": (["--box", "10,20,0,30"], "width and height must be positive"),
    "box outside": (["--box", "500,20,16,30"], "outside the 96x64 frame"),
    "one pixel": (["--box", "10,20,1,1"], "less than 2x2 pixels"),
    "unknown tracker": (["--box", TEXT, "--tracker", "magic"], "unknown tracker 'magic'; choose one of mean-shift"),
    "no particles": (["--box", TEXT, "--particles", "0"], "n_particles must be at least 1, got 0"),
    "half a particle": (["--box", TEXT, "--particles", "0.5"], "argument --particles: invalid int value"),
    "too many particles": (["--box", TEXT, "--particles", "9" * 15], "particles|memory|allocate"),
    "camshift with particles": (["--box", TEXT, "--tracker", "camshift", "--particles", "10"], "no particles"),
    "mean-shift with a seed": (["--box", TEXT, "--tracker", "mean-shift", "--seed", "1"], "no seed"),
    "negative seed": (["--box", TEXT, "--seed", "-1"], "seed"),
    "unknown option": (["--box", TEXT, "--frobnicate"], "unrecognized arguments: --frobnicate"),
}


@pytest.mark.parametrize(("arguments", "hint"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS.keys())
def test_a_bad_argument_is_one_line_and_leaves_nothing(film, out, capfd, arguments, hint):
    assert run("track", film, "--csv", out / "a.csv", "--video", out / "a.mp4", *arguments) == 2
    assert list(out.iterdir()) == []
    assert_matches(hint, one_line(capfd))


@pytest.mark.parametrize(
    "options",
    [["--csv", "nowhere/a.csv"], ["--video", "nowhere/a.mp4"], ["--video", "a.mp4", "--csv", "nowhere/a.csv"]],
    ids=["csv", "video", "csv after a good video"],
)
def test_a_missing_output_folder_is_one_line_and_leaves_nothing(film, out, capfd, options, monkeypatch):
    monkeypatch.chdir(out)
    assert run("track", film, "--box", TEXT, *options) == 2
    assert_matches("folder nowhere does not exist", one_line(capfd))
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    "options",
    [["--csv", "out"], ["--video", "out"], ["--video", "a.mp4", "--csv", "out"]],
    ids=["csv", "video", "csv after a good video"],
)
def test_an_output_that_is_a_folder_is_one_line_and_leaves_nothing(film, out, capfd, options, monkeypatch):
    monkeypatch.chdir(out.parent)
    assert run("track", film, "--box", TEXT, *options) == 2
    assert_matches("directory|folder", one_line(capfd))
    assert list(out.iterdir()) == []
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("option", ["--csv", "--video"])
def test_an_old_result_outlives_a_failed_run(tmp_path, out, option):
    (out / "result").write_text("old")
    source = sized(tmp_path / "source")
    assert run("track", source, "--box", TEXT, option, out / "result") == 2
    assert (out / "result").read_text() == "old"
    assert [path.name for path in out.iterdir()] == ["result"]


FULL_DISK = """
import resource, signal, sys
from pftrack.cli import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # writing beyond the limit is then an error like that of a full disk
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="this system has no limit of file sizes")
@pytest.mark.parametrize(
    ("limit", "options"),
    [(100, ["--csv"]), (1500, ["--video"]), (0, ["--video"]), (400, ["--video", "--csv"])],
    ids=["csv", "video", "nothing fits", "both"],
)
def test_a_full_disk_is_one_line_and_leaves_nothing(film, out, limit, options):
    outputs = [word for option in options for word in (option, str(out / f"result{option}"))]
    command = [sys.executable, "-c", FULL_DISK, str(limit), "track", str(film), "--box", TEXT, "--particles", "5"]
    result = subprocess.run([*command, *outputs], capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert result.returncode == 2
    assert result.stdout == ""
    assert_matches("^pftrack: .*(File too large|No space)", result.stderr)
    assert len(result.stderr.splitlines()) == 1
    assert list(out.iterdir()) == []


INTERRUPTIBLE = """
import signal, sys
from pftrack.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever the parent does with it
sys.exit(main(sys.argv[1:]))
"""


def test_ctrl_c_leaves_no_file_and_exits_130(film, tmp_path, out):
    """The signal is sent once the half-written video is there, in the middle of a track of some minutes."""
    long = tmp_path / "long"
    long.mkdir()
    for n in range(3000):
        os.link(film / f"{n % N_FRAMES:03}.png", long / f"{n:05}.png")
    options = ["--box", TEXT, "--particles", "3000", "--csv", str(out / "a.csv"), "--video", str(out / "a.mp4")]
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTIBLE, "track", str(long), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
    )
    deadline = time.monotonic() + 30
    while not list(out.iterdir()) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.3)
    begun = [path.name for path in out.iterdir()]
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=30)
    assert begun  # else the test would prove nothing
    assert process.returncode == 130
    assert errors == "pftrack: interrupted; nothing was written\n"
    assert output == ""
    assert list(out.iterdir()) == []


# ---------------------------------------------------------------------------------------------------------------------
# pftrack multi
# ---------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def found(tmp_path):
    """Detections of the one target of the film, frames from 1."""
    path = tmp_path / "det.txt"
    path.write_text("".join(f"{n + 1},-1,{10 + 2 * n},20,16,30,1,-1,-1,-1\n" for n in range(N_FRAMES)))
    return path


def test_the_mot_file_holds_what_python_computes(film, found, out, capfd):
    assert run("multi", film, "--detections", found, "--particles", 40, "--seed", 3, "--mot", out / "a.txt") == 0
    assert capfd.readouterr().out == f"{N_FRAMES} frames, 1 pedestrians\n"
    tracker = pftrack.AssociationParticleFilter(40, seed=3)
    frames = datasets.open_frames(film)
    rows = multi.table(multi.follow(tracker, frames, datasets.readers.read_mot(found)))
    np.testing.assert_allclose(datasets.readers.read_mot(out / "a.txt"), rows, rtol=1e-4)
    np.testing.assert_array_equal(rows[:, 0], np.arange(2, N_FRAMES))  # from the third frame it is seen in
    np.testing.assert_allclose(rows[:, 2], 10 + 2 * rows[:, 0], atol=4)


def test_the_video_of_many_plays_and_shows_their_boxes(film, found, out):
    assert run("multi", film, "--detections", found, "--video", out / "a.mp4") == 0
    facts = video_facts(out / "a.mp4")
    assert (facts["codec"], facts["pixels"], facts["n_frames"]) == ("h264", "yuv420p", N_FRAMES)
    before, after = (datasets.open_frames(out / "a.mp4")[t].astype(int) for t in (0, N_FRAMES - 1))
    plain = [picture(t).astype(int) for t in (0, N_FRAMES - 1)]
    assert np.abs(after - plain[1]).mean() > 2 * np.abs(before - plain[0]).mean()


def test_a_film_without_pedestrians_has_none(film, out, capfd):
    assert run("multi", film, "--mot", out / "a.txt") == 0
    assert capfd.readouterr().out == f"{N_FRAMES} frames, 0 pedestrians\n"
    assert (out / "a.txt").read_text() == ""


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["--tracker", "color-pf"], "choose one of bof-pf, boosted-pf, association-pf"),
        (["--particles", "0"], "at least 1"),
        (["--seed", "-1"], "seed"),
        (["--detections", "no.txt"], "there is no file no.txt"),
        (["--video", "no/such/folder.mp4"], "no/such"),
    ],
)
def test_a_bad_argument_of_multi_is_one_line_and_leaves_nothing(film, out, capfd, arguments, hint):
    assert run("multi", film, *arguments, "--mot", out / "a.txt") == 2
    assert_matches(hint, one_line(capfd))
    assert list(out.iterdir()) == []


def test_a_missing_source_of_multi_is_one_line(capfd):
    assert run("multi", "nowhere.mp4") == 2
    assert_matches("no file, folder or dataset 'nowhere.mp4'", one_line(capfd))


# ---------------------------------------------------------------------------------------------------------------------
# pftrack evaluate
# ---------------------------------------------------------------------------------------------------------------------


def write_boxes(path: Path, boxes) -> Path:
    lines = ["frame,x,y,w,h,score,lost"]
    for n, box in enumerate(boxes):
        sides = ["" if np.isnan(side) else f"{side:.3f}" for side in box]
        lines.append(",".join([str(n), *sides, "0.5", "0"]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def pair(tmp_path):
    """Boxes of a tracker and of the truth, with a hidden frame and a missing one, and their files."""
    rng = np.random.default_rng(1)
    truth = np.round(rng.uniform(20, 60, (30, 4)), 3)
    boxes = np.round(truth + rng.normal(0, 6, (30, 4)), 3)
    truth[4] = np.nan
    boxes[9] = np.nan
    return boxes, truth, write_boxes(tmp_path / "boxes.csv", boxes), write_boxes(tmp_path / "truth.csv", truth)


def test_the_table_and_the_json_agree_with_the_metrics(pair, capfd):
    boxes, truth, result, reference = pair
    expected = metrics.single_target(boxes, truth).as_dict()
    assert expected["n_hidden"] == expected["n_missing"] == 1
    assert run("evaluate", result, reference, "--json") == 0
    assert json.loads(capfd.readouterr().out) == pytest.approx(expected)
    assert run("evaluate", result, reference) == 0
    table = dict(line.split() for line in capfd.readouterr().out.splitlines())
    assert list(table) == list(expected)
    for name, value in expected.items():
        assert float(table[name]) == pytest.approx(value, abs=0.00051)


def test_a_dataset_may_be_the_truth(out, capfd):
    scene = datasets.load("synthetic-occlusion")
    boxes = np.nan_to_num(scene.boxes, nan=5.0) + [1, 2, 0, 0]
    result = write_boxes(out / "boxes.csv", boxes)
    assert run("evaluate", result, "synthetic-occlusion", "--json") == 0
    score = json.loads(capfd.readouterr().out)
    assert score == pytest.approx(metrics.single_target(boxes, scene.boxes).as_dict())
    assert score["center_error_mean"] == pytest.approx(np.sqrt(5))
    assert score["n_hidden"] == np.isnan(scene.boxes[:, 0]).sum() > 0


def test_what_track_writes_evaluate_reads(out, capfd):
    assert run("track", "synthetic-walk", "--tracker", "camshift", "--csv", out / "boxes.csv") == 0
    capfd.readouterr()
    assert run("evaluate", out / "boxes.csv", "synthetic-walk", "--json") == 0
    scene = datasets.load("synthetic-walk")
    boxes = trackers.track(trackers.CamShiftTracker(), scene.frames, scene.boxes[0])
    expected = metrics.single_target(boxes, scene.boxes).as_dict()
    assert json.loads(capfd.readouterr().out) == pytest.approx(expected, abs=0.001)


def test_frames_absent_from_a_result_count_as_missing(tmp_path, capfd):
    truth = write_boxes(tmp_path / "truth.csv", [[0, 0, 10, 10]] * 3)
    (tmp_path / "boxes.csv").write_text("frame,x,y,w,h\n2,0,0,10,10\n0,0,0,10,10\n")
    assert run("evaluate", tmp_path / "boxes.csv", truth, "--json") == 0
    score = json.loads(capfd.readouterr().out)
    assert score["n_missing"] == 1
    assert score["overlap_all"] == pytest.approx(2 / 3)


def test_json_is_valid_even_when_there_is_nothing_to_measure(tmp_path, capfd):
    """NaN is no JSON: jq, JavaScript and every strict parser refuse it."""
    truth = write_boxes(tmp_path / "truth.csv", [[0, 0, 10, 10]] * 3)
    result = write_boxes(tmp_path / "boxes.csv", [[np.nan] * 4] * 3)
    assert run("evaluate", result, truth, "--json") == 0

    def refuse(word):
        pytest.fail(f"{word} is no JSON")

    assert json.loads(capfd.readouterr().out, parse_constant=refuse)["n_missing"] == 3


BAD_RESULTS = {
    "empty": ("", "columns frame,x,y,w,h"),
    "head alone": ("frame,x,y,w,h\n", "columns frame,x,y,w,h"),
    "other columns": ("a,b,c\n1,2,3\n", "columns frame,x,y,w,h"),
    "no head": ("0,1,2,3,4\n1,1,2,3,4\n", "columns frame,x,y,w,h"),
    "words": ("frame,x,y,w,h\n0,one,2,3,4\n", "columns frame,x,y,w,h"),
    "half a frame": ("frame,x,y,w,h\n0.5,1,2,3,4\n", "columns frame,x,y,w,h"),
    "a negative frame": ("frame,x,y,w,h\n0,1,2,3,4\n-1,5,6,7,8\n1,1,2,3,4\n2,1,2,3,4\n", "frame"),
    "a frame beyond memory": ("frame,x,y,w,h\n999999999999,1,2,3,4\n", "frame|memory|allocate"),
    "one long line": ("x" * 200_000, "columns frame,x,y,w,h"),
    "another length": ("frame,x,y,w,h\n0,1,2,3,4\n", r"has 1 frames but .*truth\.csv has 3"),
    "a picture": (b"\xff\xd8\xff\xe0\x00\x10", "columns frame,x,y,w,h"),
}


@pytest.mark.parametrize(("content", "hint"), BAD_RESULTS.values(), ids=BAD_RESULTS.keys())
def test_a_bad_result_is_one_line(tmp_path, capfd, content, hint):
    truth = write_boxes(tmp_path / "truth.csv", [[0, 0, 10, 10]] * 3)
    (tmp_path / "boxes.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    assert run("evaluate", tmp_path / "boxes.csv", truth) == 2
    line = one_line(capfd)
    assert_matches(hint, line)
    assert "boxes.csv" in line


def test_a_missing_result_or_truth_is_one_line(tmp_path, capfd):
    truth = write_boxes(tmp_path / "truth.csv", [[0, 0, 10, 10]])
    for arguments in ((tmp_path / "none.csv", truth), (truth, tmp_path / "none.csv"), (tmp_path, truth)):
        assert run("evaluate", *arguments) == 2
        assert_matches("no file .*", one_line(capfd))


def test_a_truth_that_is_always_hidden_is_one_line(tmp_path, capfd):
    hidden = write_boxes(tmp_path / "hidden.csv", [[np.nan] * 4] * 2)
    boxes = write_boxes(tmp_path / "boxes.csv", [[0, 0, 10, 10]] * 2)
    assert run("evaluate", boxes, hidden) == 2
    assert_matches("hidden in every frame", one_line(capfd))


def write_rows(path: Path, tracks) -> Path:
    readers.write_mot(path, tracks)
    return path


@pytest.fixture
def crowd(tmp_path):
    """Tracks of a tracker, with two swapped half-way and boxes that are a little off, and the truth."""
    truth = datasets.load("synthetic-crowd").tracks
    tracks = truth + np.random.default_rng(1).integers(-2, 3, truth.shape) * [0, 0, 1, 1, 0, 0, 0]
    late = tracks[:, 0] >= 50
    tracks[late, 1] = np.array([0, 2, 1, 3, 4, 5])[tracks[late, 1].astype(int)]
    return tracks, truth, write_rows(tmp_path / "tracks.txt", tracks)


@pytest.mark.parametrize("kind", ["dataset", "rows"])
def test_tracks_of_many_are_scored(crowd, tmp_path, capfd, kind):
    tracks, truth, result = crowd
    expected = metrics.multi_target(tracks, truth).as_dict()
    assert expected["mota"] > expected["idf1"] > 0.5
    reference = "synthetic-crowd" if kind == "dataset" else write_rows(tmp_path / "truth.csv", truth)
    assert run("evaluate", result, reference, "--json") == 0
    assert json.loads(capfd.readouterr().out) == pytest.approx(expected)
    assert run("evaluate", result, reference) == 0
    lines = capfd.readouterr().out.splitlines()
    assert len({len(line) for line in lines}) == 1
    table = dict(line.split() for line in lines)
    assert list(table) == list(expected)
    for name, value in expected.items():
        assert float(table[name]) == pytest.approx(value, abs=0.00051)


def test_the_truth_may_be_xml(tmp_path, capfd):
    boxes = "".join(
        f'<frame number="{t}"><objectlist><object id="8"><box xc="{20 + t}" yc="30" w="10" h="20"/></object>'
        "</objectlist></frame>"
        for t in range(4)
    )
    (tmp_path / "truth.xml").write_text(f"<dataset>{boxes}</dataset>")
    result = write_rows(tmp_path / "tracks.txt", [[t, 1, 15 + t, 20, 10, 20, 1] for t in range(3)])
    assert run("evaluate", result, tmp_path / "truth.xml", "--json") == 0
    score = json.loads(capfd.readouterr().out)
    assert (score["n_matched"], score["misses"], score["motp"]) == (3, 1, 1)


def test_true_boxes_that_are_flagged_do_not_count(tmp_path, capfd):
    truth = [[t, id, 50 * id, 20, 10, 20, id != 2] for t in range(3) for id in (1, 2)]
    result = write_rows(tmp_path / "tracks.txt", [[t, 1, 50, 20, 10, 20, 0] for t in range(3)])
    assert run("evaluate", result, write_rows(tmp_path / "truth.txt", truth), "--json") == 0
    score = json.loads(capfd.readouterr().out)
    assert (score["n_truth"], score["n_found"], score["mota"]) == (3, 3, 1)


@pytest.mark.parametrize("kind", ["dataset", "rows"])
def test_a_result_without_anybody_is_scored(crowd, tmp_path, capfd, kind):
    reference = "synthetic-crowd" if kind == "dataset" else crowd[2]
    assert run("evaluate", write_rows(tmp_path / "none.txt", np.empty((0, 7))), reference, "--json") == 0
    score = json.loads(capfd.readouterr().out)
    assert (score["misses"], score["mota"], score["motp"]) == (len(crowd[1]), 0, None)


def test_what_multi_writes_evaluate_reads(film, found, out, capfd):
    assert run("multi", film, "--detections", found, "--mot", out / "tracks.txt") == 0
    capfd.readouterr()
    truth = [[t, 4, 10 + 2 * t, 20, 16, 30, 1] for t in range(N_FRAMES)]
    assert run("evaluate", out / "tracks.txt", write_rows(out / "truth.txt", truth), "--json") == 0
    expected = metrics.multi_target(readers.read_mot(out / "tracks.txt"), truth)
    assert json.loads(capfd.readouterr().out) == pytest.approx(expected.as_dict())
    assert expected.n_matched == N_FRAMES - 2  # it waits for the third frame


BAD_ROWS = {
    "a short line": ("1,1,2,3,4,5,1\n2,1,2,3\n", "tracks.txt, line 2: expected"),
    "an id twice": ("1,1,2,3,4,5,1\n1,1,9,9,4,5,1\n", "id 1 twice in frame 0"),
    "frames from 0": ("0,1,2,3,4,5,1\n", "tracks.txt has a frame 0, .* from 1"),
    "half a frame": ("1.5,1,2,3,4,5,1\n", "no whole number"),
    "a negative side": ("1,1,2,3,-4,5,1\n", "negative side"),
    "beyond the film": ("101,1,2,3,4,5,1\n", "tracks.txt goes on to frame 101 but synthetic-crowd has 100"),
}


@pytest.mark.parametrize(("content", "hint"), BAD_ROWS.values(), ids=BAD_ROWS.keys())
def test_bad_tracks_are_one_line(tmp_path, capfd, content, hint):
    (tmp_path / "tracks.txt").write_text(content)
    assert run("evaluate", tmp_path / "tracks.txt", "synthetic-crowd") == 2
    assert_matches(hint, one_line(capfd))


def test_results_of_one_and_truth_of_many_do_not_mix(crowd, tmp_path, capfd):
    one = write_boxes(tmp_path / "boxes.csv", [[0, 0, 10, 10]] * 3)
    assert run("evaluate", one, crowd[2]) == 2
    assert_matches("tracks.txt is not a CSV with the columns frame,x,y,w,h", one_line(capfd))
    assert run("evaluate", crowd[2], one) == 2
    assert_matches("boxes.csv, line 1: expected 'frame,id,x,y,w,h,score'", one_line(capfd))


# ---------------------------------------------------------------------------------------------------------------------
# pftrack data
# ---------------------------------------------------------------------------------------------------------------------


ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # SHA-256 of "abc" (FIPS 180-2)


@pytest.fixture
def fake(tmp_path, monkeypatch, publish):
    """A dataset of one file, to be put at the returned path, from a server that is not there."""
    monkeypatch.setattr(registry, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    nobody = "http://127.0.0.1:9/{name}"  # the port of a service that nobody runs
    publish({"*": nobody}, {"frames/a.txt": ABC})
    return tmp_path / "cache" / "fake" / "frames" / "a.txt"


@pytest.mark.parametrize("arguments", [["data"], ["data", "list"]], ids=" ".join)
def test_data_lists_every_dataset_and_whether_it_is_here(fake, capfd, arguments):
    def listing():
        assert run(*arguments) == 0
        captured = capfd.readouterr()
        assert captured.err == ""
        return {line.split()[0]: line for line in captured.out.splitlines()}

    lines = listing()
    assert list(lines) == datasets.ids()
    assert "to download" in lines["fake"]
    assert "a title [a licence]" in lines["fake"]
    assert "by hand" in lines["caviar-corridor"]
    assert "never published" in lines["li-2012-hall"]
    assert "drawn" in lines["synthetic-walk"]
    fake.parent.mkdir(parents=True)
    fake.write_text("abc")
    assert " here " in listing()["fake"]


def test_data_path_prints_the_folder(fake, capfd):
    fake.parent.mkdir(parents=True)
    fake.write_text("abc")
    assert run("data", "path", "fake") == 0
    assert capfd.readouterr() == (f"{fake.parents[1]}\n", "")


def test_data_fetch_checks_what_is_here(fake, capfd):
    fake.parent.mkdir(parents=True)
    fake.write_text("abc")
    assert run("data", "fetch", "fake") == 0
    assert capfd.readouterr() == ("fake: 1 files complete, checksums right\n", "")
    fake.write_text("abd")
    assert run("data", "fetch", "fake") == 2
    assert_matches(r"a\.txt has the wrong SHA-256.*fetch it again", one_line(capfd))


def test_a_fetch_that_fails_is_one_line(fake, tmp_path, capfd):
    assert run("data", "fetch", "fake") == 2
    assert_matches(r"fake is not complete: frames/a\.txt .*127\.0\.0\.1:9/a\.txt failed.*PFTRACK_DATA", one_line(capfd))
    assert [path for path in (tmp_path / "cache").rglob("*") if path.is_file()] == []


def test_a_track_of_footage_that_cannot_be_had_is_one_line(fake, out, capfd):
    assert run("track", "fake", "--csv", out / "a.csv") == 2
    assert_matches("fake is not complete", one_line(capfd))
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["path", "fake"], "fake is not on this machine; pftrack data fetch fake gets it"),
        (["path", "bobot-Z"], "unknown dataset 'bobot-Z'.*bobot-I"),
        (["fetch", "bobot-Z"], "unknown dataset 'bobot-Z'.*bobot-I"),
        (["fetch"], "needs the id of a dataset; pftrack data list"),
        (["path"], "needs the id of a dataset; pftrack data list"),
        (["fetch", "li-2012-hall"], "never published"),
        (["path", "li-2012-hall"], "never published"),
        (["fetch", "caviar-corridor"], "download the JPEG frames"),
        (["path", "synthetic-walk"], "drawn|needs no files|synthetic-walk is"),
        (["fetch", "synthetic-walk"], "drawn|needs no files|synthetic-walk is"),
        (["burn"], "invalid choice: 'burn'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_bad_data_command_is_one_line(fake, capfd, arguments, hint):
    assert run("data", *arguments) == 2
    assert_matches(hint, one_line(capfd))


# ---------------------------------------------------------------------------------------------------------------------
# The command itself
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [[], ["frob"], ["track"], ["evaluate", "one.csv"]], ids=" ".join)
def test_an_incomplete_command_is_one_line_that_names_the_help(capfd, arguments):
    assert run(*arguments) == 2
    assert_matches("see pftrack.* --help", one_line(capfd))


@pytest.mark.parametrize("arguments", [["--help"], ["track", "--help"], ["evaluate", "--help"], ["data", "--help"]])
def test_help_goes_to_standard_output(capfd, arguments):
    assert run(*arguments) == 0
    captured = capfd.readouterr()
    assert captured.out.startswith("usage: pftrack")
    assert captured.err == ""


@pytest.mark.skipif(os.name != "posix", reason="needs a shell")
def test_the_command_works_where_standard_error_is_closed():
    """As under some schedulers and service managers."""
    code = "import sys; from pftrack.cli import main; sys.exit(main(['data', 'list']))"
    command = ["sh", "-c", 'exec "$0" -c "$1" 2>&-', sys.executable, code]
    result = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT, check=False)
    assert result.returncode == 0
    assert result.stdout.startswith("bobot-I")


def test_importing_the_library_and_the_command_draws_in_no_plotting():
    code = "import sys, pftrack, pftrack.cli; print(*sorted(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT, check=True)
    loaded = set(result.stdout.split())
    assert "pftrack.trackers" in loaded
    assert not {"matplotlib", "ipywidgets", "IPython", "pftrack.plots", "pandas", "scipy", "skimage", "joblib"} & loaded
