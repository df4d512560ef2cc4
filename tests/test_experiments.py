"""Repeated runs: the boxes are those of a plain loop, whoever computes them, and nothing is computed twice.

The truth is always `pftrack.track`, called here run by run.
"""

import dataclasses
import functools
import inspect
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import joblib
import numpy as np
import pytest

import pftrack
from pftrack import datasets, experiments, metrics
from pftrack.datasets.frames import EndOfFilm, Frames
from pftrack.experiments import Run
from pftrack.trackers import TRACKERS

SCENE = "synthetic-walk"
LOAD = datasets.load
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(pftrack.__file__).parents[1])}


def few(n: int, n_particles: int = 5) -> list[Run]:
    return experiments.grid("color-pf", SCENE, seeds=range(n), settings={"n_particles": n_particles})


class Held(Frames):
    """Frames in memory, since a synthetic scene is drawn anew whenever it is read."""

    def __init__(self, frames):
        self.frames = list(frames)

    def __len__(self):
        return len(self.frames)

    def read(self, index):
        return self.frames[index]


@functools.cache
def held(id: str) -> datasets.Sequence:
    scene = LOAD(id)
    return dataclasses.replace(scene, frames=Held(scene.frames))


@functools.cache
def plain(one: Run) -> np.ndarray:
    """What the run must give: one tracker, one loop."""
    sequence = held(one.sequence)
    truth = sequence.boxes if one.target is None else sequence.target(one.target)
    seed = {} if one.seed is None else {"seed": one.seed}
    return pftrack.track(TRACKERS[one.tracker](**dict(one.settings), **seed), sequence.frames, truth[0])


def assert_same(found, runs) -> None:
    assert len(found) == len(runs)
    for boxes, one in zip(found, runs, strict=True):
        np.testing.assert_array_equal(boxes, plain(one))


class Recorder:
    """A tracker that follows nothing and notes what is done to it."""

    log: list[tuple]  # a new one for each test

    def __init__(self, seed=0, width=1.0):
        self.seed, self.width = seed, width

    def init(self, shown, box):
        return self._note("init", shown, box)

    def update(self, shown):
        return self._note("update", shown, (0, 0, 2, 2))

    def _note(self, what, shown, box):
        self.log.append((what, self.seed, self.width, shown))
        return pftrack.Estimate(np.array(box, dtype=float) + self.seed, 1.0, lost=False)


class Preparer(Recorder):
    """The same, with something to prepare."""

    def prepare(self, frame):
        self.log.append(("prepare", self.seed, self.width, frame))
        return "prepared", len(self.log)


@pytest.fixture
def log(monkeypatch):
    """The notes of both trackers, which for one test are in the list of trackers, and run on ten frames."""
    notes = []
    scene = held(SCENE)
    short = dataclasses.replace(scene, frames=Held(scene.frames[:10]), tracks=scene.tracks[scene.tracks[:, 0] < 10])
    monkeypatch.setattr(datasets, "load", lambda id, progress=True: short)
    monkeypatch.setattr(Recorder, "log", notes, raising=False)
    monkeypatch.setitem(TRACKERS, "recorder", Recorder)
    monkeypatch.setitem(TRACKERS, "preparer", Preparer)
    return notes


def begun(log) -> list[int]:
    """Seeds of the runs that were begun."""
    return [seed for what, seed, *_ in log if what == "init"]


# ---------------------------------------------------------------------------------------------------------------------
# What to run
# ---------------------------------------------------------------------------------------------------------------------


def test_a_run_is_the_same_however_its_settings_are_written():
    noise = (0.2, 0.2, 0.01, 0.01, 0.03)
    runs = {
        Run("color-pf", SCENE, 1, {"noise": noise, "n_particles": 20}),
        Run("color-pf", SCENE, np.int64(1), {"n_particles": np.int64(20), "noise": np.array(noise)}),
        Run("color-pf", SCENE, 1, (("noise", list(noise)), ("n_particles", 20), ("sigma", 0.1))),
    }
    assert len(runs) == 1
    assert runs.pop().settings == (("n_particles", 20), ("noise", noise))


def test_all_settings_are_those_the_tracker_has():
    one = Run("color-pf", SCENE, 4, {"sigma": 0.2, "resampler": "residual"})
    tracker = one.make_tracker()
    assert one.all_settings.keys() == inspect.signature(type(tracker)).parameters.keys() - {"seed"}
    assert (tracker.seed, tracker.sigma, tracker.resampler) == (4, 0.2, pftrack.smc.RESAMPLERS["residual"])
    for name in ("n_particles", "sigma", "lost_distance", "scale_range", "outside"):
        assert one.all_settings[name] == getattr(tracker, name)
    assert Run("camshift", SCENE, settings={"value": [40, 200]}).make_tracker().value == (40, 200)


@pytest.mark.parametrize(
    ("arguments", "kind", "hint"),
    [
        (("colour-pf", SCENE, 0), ValueError, "unknown tracker 'colour-pf'; choose one of .*color-pf"),
        (("color-pf", "bobot-Z", 0), ValueError, "unknown dataset 'bobot-Z'; there are .*bobot-I"),
        (("color-pf", SCENE), ValueError, "give the run a seed"),
        (("camshift", SCENE, 0), ValueError, "leave its seed None"),
        (("color-pf", SCENE, 0, {"particles": 5}), ValueError, "no setting 'particles'; it has n_particles"),
        (("color-pf", SCENE, 0, {"seed": 5}), ValueError, "no setting 'seed'"),
        (("color-pf", SCENE, 0, {"noise": {"x": 1}}), TypeError, "must be a number, a word"),
    ],
)
def test_a_run_that_cannot_be_is_refused(arguments, kind, hint):
    with pytest.raises(kind, match=hint):
        Run(*arguments)


def test_a_grid_holds_every_combination_in_order():
    runs = experiments.grid(
        ["camshift", "color-pf"],
        [SCENE, ("synthetic-crossing", 2)],
        seeds=[7, 3],
        settings=[{}],
    )
    assert [(one.tracker, one.sequence, one.target, one.seed) for one in runs] == [
        ("camshift", SCENE, None, None),
        ("camshift", "synthetic-crossing", 2, None),
        ("color-pf", SCENE, None, 7),
        ("color-pf", SCENE, None, 3),
        ("color-pf", "synthetic-crossing", 2, 7),
        ("color-pf", "synthetic-crossing", 2, 3),
    ]


def test_a_grid_takes_generators():
    settings = ({"n_particles": n} for n in (5, 6))
    runs = experiments.grid(
        iter(["color-pf"]), iter([SCENE, "synthetic-crossing"]), seeds=iter([0, 1]), settings=settings
    )
    assert len(set(runs)) == 8


# ---------------------------------------------------------------------------------------------------------------------
# The boxes
# ---------------------------------------------------------------------------------------------------------------------


def mixture() -> list[Run]:
    """Runs of all kinds, none next to its like."""
    variants = [{"n_particles": 5}, {"n_particles": 8, "outside": "ignore", "resampler": "stratified"}]
    runs = experiments.grid("color-pf", SCENE, seeds=range(3), settings=variants)
    runs += experiments.grid("camshift", ["synthetic-crossing", ("synthetic-crossing", 2)])
    runs += experiments.grid("mean-shift", SCENE, settings={"saturation": (30, 255)})
    random.Random(0).shuffle(runs)
    return runs


@pytest.mark.parametrize("group_size", [None, 1, 2])
def test_boxes_are_those_of_a_plain_loop_to_the_bit(group_size, monkeypatch):
    monkeypatch.setattr(datasets, "load", lambda id, progress=True: held(id))
    runs = mixture()
    assert_same(experiments.run(runs, n_jobs=1, group_size=group_size, progress=False), runs)


def test_two_processes_and_a_store_change_nothing(tmp_path):
    runs = [*mixture()[:4], *experiments.grid("camshift", [("synthetic-crossing", 1), ("synthetic-crossing", 2)])]
    for n_jobs in (2, 1):  # the second time everything comes out of the store
        assert_same(
            experiments.run(runs, n_jobs=n_jobs, group_size=2, store=tmp_path / "a" / "b", progress=False), runs
        )


def test_the_same_call_on_a_dask_cluster_gives_the_same_bits(tmp_path):
    distributed = pytest.importorskip("distributed")
    runs = few(2) + experiments.grid("camshift", SCENE)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
        joblib.parallel_config("dask"),
    ):
        assert len(client.scheduler_info()["workers"]) == 2
        found = experiments.run(runs, group_size=1, store=tmp_path, progress=False)
        used = client.run(lambda: "pftrack.experiments" in sys.modules)
    assert list(used.values()) == [True, True]  # both workers had a part in it, in processes of their own
    assert_same(found, runs)
    assert len(list(tmp_path.rglob("*.npy"))) == len(runs)  # the caller keeps them, wherever the workers are


def test_a_film_that_ends_early_ends_in_nan(monkeypatch):
    class Short(Held):
        def read(self, index):
            if index >= 6:
                raise EndOfFilm("the film ends")
            return self.frames[index]

    scene = held(SCENE)
    cut = dataclasses.replace(scene, frames=Short(scene.frames[:9]), tracks=scene.tracks[scene.tracks[:, 0] < 9])
    monkeypatch.setattr(datasets, "load", lambda id, progress=True: cut)
    (one,) = few(1)
    (boxes,) = experiments.run([one], n_jobs=1, progress=False)
    assert boxes.shape == (9, 4)
    assert np.isnan(boxes).all(axis=1).tolist() == [False] * 6 + [True] * 3
    np.testing.assert_array_equal(boxes, pftrack.track(one.make_tracker(), cut.frames, cut.boxes[0]))


# ---------------------------------------------------------------------------------------------------------------------
# Work done once
# ---------------------------------------------------------------------------------------------------------------------


def test_every_frame_is_prepared_once_for_all_seeds_of_equal_settings(log):
    runs = experiments.grid("preparer", SCENE, seeds=range(3), settings=[{"width": 1.0}, {"width": 2.0}])
    boxes = experiments.run(runs, n_jobs=1, progress=False)
    frames = datasets.load(SCENE).frames
    assert len(log) == 2 * len(frames) * 4  # two settings, and one preparation for three trackers
    for t, start in enumerate(range(0, len(log), 4)):
        (prepare, *steps) = log[start : start + 4]
        assert prepare[0] == "prepare"
        np.testing.assert_array_equal(prepare[3], frames[t % len(frames)])
        what = "init" if t % len(frames) == 0 else "update"
        width = 1.0 if t < len(frames) else 2.0
        assert prepare[2] == width
        assert [step[:3] for step in steps] == [(what, seed, width) for seed in range(3)]
        assert all(step[3] == ("prepared", start + 1) for step in steps)
    np.testing.assert_array_equal(boxes[4][0], datasets.load(SCENE).boxes[0] + 1)


def test_without_preparation_the_trackers_share_the_decoded_frame(log):
    experiments.run(experiments.grid("recorder", SCENE, seeds=range(4)), n_jobs=1, progress=False)
    frames = datasets.load(SCENE).frames
    for t, frame in enumerate(frames):
        shown = [step[3] for step in log[4 * t : 4 * t + 4]]
        np.testing.assert_array_equal(shown[0], frame)
        assert all(other is shown[0] for other in shown)


def test_a_run_that_occurs_twice_is_done_once(log):
    runs = experiments.grid("recorder", SCENE, seeds=[1, 0, 1])
    boxes = experiments.run(runs, n_jobs=1, progress=False)
    assert sorted(begun(log)) == [0, 1]
    assert [box[1, 0] for box in boxes] == [1.0, 0.0, 1.0]


# ---------------------------------------------------------------------------------------------------------------------
# Who does it
# ---------------------------------------------------------------------------------------------------------------------


def test_an_enclosing_context_says_who_works(log, monkeypatch):
    threads = set()
    monkeypatch.setattr(
        Recorder, "_note", lambda *_: threads.add(threading.get_ident()) or pftrack.trackers.base.MISSING
    )
    runs = experiments.grid("recorder", SCENE, seeds=range(4))
    main = threading.get_ident()
    with joblib.parallel_config("threading", n_jobs=2):
        experiments.run(runs, group_size=1, progress=False)
        assert main not in threads
        threads.clear()
        experiments.run(runs, n_jobs=1, progress=False)  # said in the call, it counts more
        assert threads == {main}
    threads.clear()
    with joblib.parallel_config(n_jobs=1):
        experiments.run(runs, progress=False)
    assert threads == {main}


def test_without_a_context_every_core_works(log, monkeypatch):
    asked = []

    class Spy(joblib.Parallel):
        def __init__(self, n_jobs=None, **options):
            asked.append(n_jobs)
            super().__init__(1, **options)

    monkeypatch.setattr(joblib, "Parallel", Spy)
    runs = experiments.grid("recorder", SCENE, seeds=range(2))
    experiments.run(runs, progress=False)
    with joblib.parallel_config("threading"):
        experiments.run(runs, progress=False)
    with joblib.parallel_config(n_jobs=3):
        experiments.run(runs, progress=False)
    assert asked == [-1, -1, None]


def test_the_progress_bar_counts_runs(log, tmp_path, capsys):
    runs = experiments.grid("recorder", SCENE, seeds=range(7))
    experiments.run(runs[:3], n_jobs=1, store=tmp_path)
    assert "3/3" in capsys.readouterr().err
    experiments.run(runs, n_jobs=1, store=tmp_path, group_size=2)
    shown = capsys.readouterr().err
    assert " 3/7 " in shown  # what the store had is not done again
    assert " 7/7 " in shown
    experiments.run(runs, n_jobs=1, progress=False)
    assert capsys.readouterr() == ("", "")


def test_no_runs_are_no_boxes():
    assert experiments.run([], progress=False) == []


# ---------------------------------------------------------------------------------------------------------------------
# Interruptions and the store
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [KeyboardInterrupt, ValueError, MemoryError])
def test_after_an_interruption_only_the_rest_is_done(log, tmp_path, monkeypatch, kind):
    runs = experiments.grid("recorder", SCENE, seeds=range(6))
    plainly = Recorder.update

    def stop(self, shown):
        if self.seed == 4 and len(log) > 45:
            raise kind("stop")
        return plainly(self, shown)

    monkeypatch.setattr(Recorder, "update", stop)
    with pytest.raises(kind, match="stop"):
        experiments.run(runs, n_jobs=1, store=tmp_path, group_size=1, progress=False)
    assert begun(log) == [0, 1, 2, 3, 4]
    monkeypatch.setattr(Recorder, "update", plainly)
    log.clear()
    boxes = experiments.run(runs, n_jobs=1, store=tmp_path, group_size=1, progress=False)
    assert begun(log) == [4, 5]
    assert [box[1, 0] for box in boxes] == [0, 1, 2, 3, 4, 5]
    assert {path.suffix for path in tmp_path.rglob("*") if path.is_file()} == {".npy"}  # nothing half-written


def test_an_error_in_a_worker_process_keeps_what_was_finished(tmp_path, monkeypatch):
    good = few(4)
    bad = Run("color-pf", SCENE, 0, target=99)
    with pytest.raises(ValueError, match="99"):
        experiments.run([*good, bad], n_jobs=2, store=tmp_path, group_size=1, progress=False)
    kept = len(list(tmp_path.rglob("*.npy")))
    assert 0 < kept <= len(good)
    starts = []
    init = pftrack.ColorParticleFilter.init

    def counting(self, shown, box):
        starts.append(self.seed)
        return init(self, shown, box)

    monkeypatch.setattr(pftrack.ColorParticleFilter, "init", counting)
    found = experiments.run(good, n_jobs=1, store=tmp_path, progress=False)
    assert len(starts) == len(good) - kept
    assert_same(found, good)


INTERRUPTIBLE = """
import signal, sys
from pftrack import experiments
signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever the parent does with it
runs = experiments.grid("color-pf", "synthetic-walk", seeds=range(500), settings={"n_particles": 5})
try:
    experiments.run(runs, store=sys.argv[1], n_jobs=2, group_size=1, progress=False)
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.skipif(os.name != "posix", reason="sends a signal to a group of processes")
def test_ctrl_c_stops_the_workers_and_keeps_what_was_finished(tmp_path):
    """As at a terminal: caller and workers, who are at work by then, all get the signal."""
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTIBLE, str(tmp_path)],
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    while len(list(tmp_path.rglob("*.npy"))) < 20 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors == ""
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert 0 < len(files) < 500
    assert {path.suffix for path in files} == {".npy"}
    assert {np.load(path).shape for path in files} == {(100, 4)}


def test_a_full_disk_is_one_error(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    monkeypatch.setattr(datasets, "load", lambda id, progress=True: held(id))
    with joblib.parallel_config("threading", n_jobs=2), pytest.raises(OSError, match="No space"):
        experiments.run(few(4), store=tmp_path, group_size=1, progress=False)  # and joblib warns of nothing
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_damaged_file_is_computed_anew(log, tmp_path):
    runs = experiments.grid("recorder", SCENE, seeds=range(3))
    expected = experiments.run(runs, n_jobs=1, store=tmp_path, progress=False)
    empty, half, good = tmp_path.rglob("*.npy")
    empty.write_bytes(b"")
    half.write_bytes(good.read_bytes()[:300])
    log.clear()
    found = experiments.run(runs, n_jobs=1, store=tmp_path, progress=False)
    assert len(begun(log)) == 2
    np.testing.assert_array_equal(found, expected)


def test_what_other_code_computed_is_not_taken(log, tmp_path, monkeypatch):
    runs = experiments.grid("recorder", SCENE, seeds=range(2))
    experiments.run(runs, n_jobs=1, store=tmp_path, progress=False)
    monkeypatch.setattr(experiments, "LIBRARY", "another" * 8)
    experiments.run(runs, n_jobs=1, store=tmp_path, progress=False)
    assert begun(log) == [0, 1, 0, 1]


def test_a_worker_with_another_library_is_refused(monkeypatch):
    monkeypatch.setattr(experiments, "LIBRARY", "another" * 8)  # here, but not in the other process
    with pytest.raises(ValueError, match="install the same everywhere"):
        experiments.run(few(2), n_jobs=2, group_size=1, progress=False)


def write_library(folder: Path, **changes) -> Path:
    files = {"smc.py": "a = 1", "trackers/pf.py": "b = 2", "datasets/checksums/x.txt": "00 x", "plots.py": "c = 3"}
    for name, text in (files | changes).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def test_the_digest_tells_apart_every_library_that_may_compute_otherwise(tmp_path, monkeypatch):
    first = experiments.library_digest(write_library(tmp_path / "first"))
    assert experiments.library_digest(write_library(tmp_path / "elsewhere")) == first
    assert experiments.library_digest(write_library(tmp_path / "plots", **{"plots.py": "c = 4"})) == first
    changes = [
        {"smc.py": "a = 2"},
        {"trackers/pf.py": "b = 3"},
        {"datasets/checksums/x.txt": "01 x"},
        {"new.py": ""},
        {"trackers/plots.py": ""},
    ]
    digests = {
        experiments.library_digest(write_library(tmp_path / str(n), **change)) for n, change in enumerate(changes)
    }
    monkeypatch.setattr(np, "__version__", "1.0")
    digests.add(experiments.library_digest(tmp_path / "first"))
    assert len(digests | {first}) == len(changes) + 2


@pytest.mark.parametrize("group_size", [0, -1])
def test_a_group_must_have_a_run(group_size):
    with pytest.raises(ValueError, match="group_size must be at least 1"):
        experiments.run(few(1), group_size=group_size)


def test_a_target_that_cannot_be_started_on_is_named():
    scene = datasets.load("synthetic-crowd")
    late = next(id for id in scene.ids if np.isnan(scene.target(id)[0]).any())
    with pytest.raises(ValueError, match=f"target={late}.* not to be seen in the first frame"):
        Run("camshift", scene.name, target=late).load()


# ---------------------------------------------------------------------------------------------------------------------
# Time
# ---------------------------------------------------------------------------------------------------------------------


def test_time_per_frame_is_that_of_update_alone(log, monkeypatch):
    def slow(self, shown):
        time.sleep(0.005)
        return self._note("update", shown, (0, 0, 2, 2))

    monkeypatch.setattr(Recorder, "update", slow)
    times = experiments.time_per_frame(Run("preparer", SCENE, 0), n_frames=4, repeats=3)
    assert times.shape == (3,)
    assert np.all(times >= 5)
    assert times.min() < 50
    assert [what for what, *_ in log] == ["init", *["update"] * 4] * 4  # three passes after one to warm up
    frames = datasets.load(SCENE).frames
    for n, (*_, shown) in enumerate(log):  # raw frames: nothing is prepared in advance
        np.testing.assert_array_equal(shown, frames[n % 5])


@pytest.mark.parametrize("numbers", [(0, 1), (1, 0)])
def test_there_must_be_something_to_time(numbers):
    with pytest.raises(ValueError, match="at least 1"):
        experiments.time_per_frame(Run("camshift", SCENE), *numbers)


# ---------------------------------------------------------------------------------------------------------------------
# The table
# ---------------------------------------------------------------------------------------------------------------------


def test_the_table_says_everything_about_every_run():
    runs = mixture()
    table = experiments.table(runs, map(plain, runs))
    assert len(table) == len(runs)
    for one, (_, row) in zip(runs, table.iterrows(), strict=True):
        assert (row["tracker"], row["sequence"]) == (one.tracker, one.sequence)
        assert row["target"] == (one.target or 1)
        assert one.seed is None if row.isna()["seed"] else row["seed"] == one.seed
        parameters = inspect.signature(TRACKERS[one.tracker]).parameters
        for name, parameter in parameters.items():
            if name != "seed":
                assert row[name] == dict(one.settings).get(name, parameter.default)
        truth = held(one.sequence).target(one.target or 1)
        for name, value in metrics.single_target(plain(one), truth).as_dict().items():
            assert row[name] == value
        others = {"n_particles", "max_iterations"} - parameters.keys()
        assert row[list(others)].isna().all()


def test_a_table_needs_boxes_for_every_run():
    with pytest.raises(ValueError, match="shorter"):
        experiments.table(few(2), [np.zeros((100, 4))])
