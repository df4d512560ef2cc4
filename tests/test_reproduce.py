"""The files behind the book: their numbers against plain loops over short scenes, and the command that writes them."""

import dataclasses
import functools
import itertools
import json
import re
import socket
from concurrent.futures import BrokenExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pftrack
from pftrack import datasets, detection, experiments, masks, metrics, multi, reproduce
from pftrack.cli import main
from pftrack.datasets import registry
from pftrack.multi import association
from pftrack.reproduce import Plan, crowd, many, rivals

SCENE = "synthetic-occlusion"
N_FRAMES = 70
MASKS = np.array([[s_low, 256, v_low, 256] for s_low in range(0, 256, 64) for v_low in range(0, 256, 32)])


@functools.cache
def scene() -> datasets.Sequence:
    """The beginning of a scene, up to where the target is hidden for some frames, held in memory."""
    whole = datasets.load(SCENE)
    part = dataclasses.replace(
        whole, frames=whole.frames[:N_FRAMES], tracks=whole.tracks[whole.tracks[:, 0] < N_FRAMES]
    )
    frames = list(part.frames)

    class Held(datasets.Frames):
        def __len__(self):
            return N_FRAMES

        def read(self, index):
            return frames[index]

    return dataclasses.replace(part, frames=Held())


@functools.cache
def scores(**settings) -> metrics.SingleTargetScore:
    tracker = pftrack.ColorParticleFilter(**settings)
    return metrics.single_target(pftrack.track(tracker, scene().frames, scene().boxes[0]), scene().boxes)


@functools.cache
def overlaps(seed: int) -> np.ndarray:
    """Overlap in each frame of the particle filter with 100 particles."""
    tracker = pftrack.ColorParticleFilter(n_particles=100, seed=seed)
    return metrics.overlap(pftrack.track(tracker, scene().frames, scene().boxes[0]), scene().boxes)


@pytest.fixture
def plan(tmp_path, monkeypatch) -> Plan:
    """A small plan on the short scene, in this process."""
    short = scene()
    monkeypatch.setattr(datasets, "load", lambda id, progress=True: short)
    return Plan(tmp_path / "results", 3, 1, SCENE, SCENE, (SCENE,), (4, 8), MASKS, tmp_path / "store", progress=False)


def made(item: str, plan: Plan) -> list[pd.DataFrame]:
    """The files that an item writes, read back."""
    return [reproduce.read(path) for path in reproduce.run(item, plan)]


# ---------------------------------------------------------------------------------------------------------------------
# Files
# ---------------------------------------------------------------------------------------------------------------------


def test_what_is_written_can_be_read_by_anybody(tmp_path):
    table = pd.DataFrame({"name": ["a", "b, c"], "n": [1, 2], "x": [1 / 3, np.nan]})
    path = reproduce.write(tmp_path / "a.csv", table, tracker="color-pf", noise=(0.1, 0.2))
    plainly = pd.read_csv(path, comment="#")
    assert plainly["name"].tolist() == ["a", "b, c"]
    assert plainly["n"].tolist() == [1, 2]
    assert plainly["x"].tolist() == pytest.approx([0.333333, np.nan], nan_ok=True, abs=0)
    read = reproduce.read(path)
    pd.testing.assert_frame_equal(read, plainly)
    assert list(read.attrs)[:2] == ["tracker", "noise"]
    assert read.attrs["noise"] == "(0.1, 0.2)"
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_a_file_says_versions_and_processor_but_not_whose_machine_it_was(tmp_path):
    path = reproduce.write(tmp_path / "a.csv", pd.DataFrame({"n": [1]}))
    about = reproduce.read(path).attrs
    assert list(about) == ["pftrack", "python", "numpy", "opencv", "numba", "processor", "cores"]
    assert about["numpy"] == np.__version__
    assert all(re.fullmatch(r"\d+(\.\d+)+.*", about[name]) for name in ("pftrack", "python", "opencv", "numba"))
    assert int(about["cores"]) >= 1
    assert about["processor"]
    assert socket.gethostname() not in about.values()
    assert str(Path.home()) not in path.read_text()


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = reproduce.write(tmp_path / "a.csv", pd.DataFrame({"n": [1]}))
    before = path.read_bytes()

    class Unprintable:
        def __str__(self):
            raise ValueError("no words")

    with pytest.raises(ValueError, match="no words"):
        reproduce.write(path, pd.DataFrame({"n": [2]}), tracker=Unprintable())
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        reproduce.read(tmp_path / "none.csv")


# ---------------------------------------------------------------------------------------------------------------------
# Spread
# ---------------------------------------------------------------------------------------------------------------------


def test_the_three_spreads_differ_as_they_should():
    """Two runs of two visible frames, 0, 4 and 1, 1: worked by hand, with sd(a, b) = |a - b| / √2."""
    found = reproduce.spread([[0, np.nan, 4], [1, np.nan, 1]])
    root = np.sqrt(2)
    assert found == pytest.approx({"mean": 1.5, "runs": 1 / root, "frames": 2 / root, "band": 2 / root})


def test_spreads_of_known_variances():
    """Runs differ by a normal with sd 3, frames by one with sd 2, and each number by one with sd 1."""
    rng = np.random.default_rng(0)
    n_runs, n_frames = 400, 500
    values = (
        3 * rng.standard_normal((n_runs, 1))
        + 2 * rng.standard_normal(n_frames)
        + rng.standard_normal((n_runs, n_frames))
    )
    found = reproduce.spread(values)
    for sense, expected, n in (
        ("runs", np.hypot(3, 1 / np.sqrt(n_frames)), n_runs),
        ("frames", np.hypot(2, 1), n_frames),
        ("band", np.hypot(3, 1), n_runs),
    ):
        assert found[sense] == pytest.approx(expected, rel=5 / np.sqrt(2 * n))  # five standard errors


def test_one_run_has_no_spread_over_runs():
    found = reproduce.spread([[1.0, 3.0]])
    assert np.isnan([found["runs"], found["band"]]).all()
    assert found["frames"] == pytest.approx(np.sqrt(2))
    assert np.isnan(reproduce.spread([[1.0], [2.0]])["frames"])


# ---------------------------------------------------------------------------------------------------------------------
# The items
# ---------------------------------------------------------------------------------------------------------------------


def test_fig3_has_every_run_and_its_mean_and_spread(plan):
    runs, summary = made("fig3", plan)
    assert runs[["n_particles", "seed"]].to_numpy().tolist() == [[n, seed] for n in (4, 8) for seed in range(3)]
    for _, row in runs.iterrows():
        for name, value in scores(n_particles=int(row["n_particles"]), seed=int(row["seed"])).as_dict().items():
            assert row[name] == pytest.approx(value, abs=0.51e-6)
    assert summary["n_particles"].tolist() == [4, 8]
    for n, (_, row) in zip((4, 8), summary.iterrows(), strict=True):
        for name in ("overlap_all", "overlap_visible", "hit_ratio_all", "hit_ratio_visible"):
            values = [getattr(scores(n_particles=n, seed=seed), name) for seed in range(3)]
            assert row[f"{name}_mean"] == pytest.approx(np.mean(values), abs=0.51e-6)
            assert row[f"{name}_sd"] == pytest.approx(np.std(values, ddof=1), abs=0.51e-6)
    assert (summary["ms_min"] > 0).all()
    assert (summary["ms_min"] <= summary["ms_median"]).all()
    assert runs.attrs["sequence"] == SCENE
    assert runs.attrs["sigma"] == "0.1"
    assert runs.attrs["runs"] == "3"
    assert "n_particles" not in runs.attrs


def test_the_paper_has_at_least_eight_numbers_of_particles():
    particles = Plan().particles
    assert len(particles) >= 8
    assert min(particles) == 10
    assert max(particles) == 2000
    assert 100 in particles
    assert (Plan().n_runs, Plan().sequence) == (100, "bobot-I")


def test_fig6b_has_every_frame_and_marks_the_hidden_ones(plan):
    (table,) = made("fig6b", plan)
    assert table["frame"].tolist() == list(range(N_FRAMES))
    rates = np.array([overlaps(seed) for seed in range(3)])
    hidden = np.isnan(scene().boxes[:, 0])
    assert 0 < hidden.sum() < N_FRAMES
    assert table["hidden"].tolist() == hidden.astype(int).tolist()
    assert table.loc[hidden, ["mean", "sd", "p05", "p95", "hits"]].isna().all(axis=None)
    seen = table[~hidden]
    np.testing.assert_allclose(seen["mean"], rates.mean(axis=0)[~hidden], atol=0.51e-6)
    np.testing.assert_allclose(seen["sd"], rates.std(axis=0, ddof=1)[~hidden], atol=0.51e-6)
    np.testing.assert_allclose(seen["hits"], (rates >= 1 / 3).mean(axis=0)[~hidden], atol=0.51e-6)
    low, middle, high = np.sort(rates, axis=0)[:, ~hidden]
    np.testing.assert_allclose(seen["p05"], low + 0.1 * (middle - low), atol=0.51e-6)  # a twentieth of the way of two
    np.testing.assert_allclose(seen["p95"], high - 0.1 * (high - middle), atol=0.51e-6)


@pytest.fixture(scope="module")
def by_opencv():
    """For both trackers, what OpenCV itself finds with every mask: overlaps and iterations."""
    found = {}
    for tracker in ("camshift", "mean-shift"):
        pairs = [masks.run_mask(scene().frames, scene().boxes[0], mask, tracker) for mask in MASKS]
        rates = np.array([metrics.overlap(windows, scene().boxes) for windows, _ in pairs])
        found[tracker] = rates, np.array([counts for _, counts in pairs])
    return found


def test_fig6a_has_the_best_masks_and_their_curve(plan, by_opencv):
    curves, found = made("fig6a", plan)
    hidden = np.isnan(scene().boxes[:, 0])
    for tracker, (rates, iterations) in by_opencv.items():
        counted = np.nan_to_num(rates)
        rows = found[found["tracker"] == tracker]
        assert rows["rank"].tolist() == [1, 2, 3]
        best = [int(np.flatnonzero((mask == MASKS).all(axis=1))[0]) for mask in rows.iloc[:, 2:6].to_numpy()]
        assert len(set(best)) == 3
        np.testing.assert_allclose(rows["overlap_all"], np.sort(counted.mean(axis=1))[::-1][:3], atol=0.51e-6)
        np.testing.assert_allclose(rows["overlap_all"], counted[best].mean(axis=1), atol=0.51e-6)
        np.testing.assert_allclose(rows["overlap_visible"], rates[best][:, ~hidden].mean(axis=1), atol=0.51e-6)
        np.testing.assert_allclose(rows["hit_ratio_all"], (counted[best] >= 1 / 3).mean(axis=1), atol=0.51e-6)
        hits = (rates[best] >= 1 / 3)[:, ~hidden]
        np.testing.assert_allclose(rows["hit_ratio_visible"], hits.mean(axis=1), atol=0.51e-6)
        np.testing.assert_allclose(rows["iterations"], iterations[best][:, 1:].mean(axis=1), atol=0.51e-6)
        name = tracker.replace("-", "_")
        np.testing.assert_allclose(curves[f"{name}_mean"], rates[best].mean(axis=0), atol=0.51e-6)
        np.testing.assert_allclose(curves[f"{name}_sd"], rates[best].std(axis=0, ddof=1), atol=0.51e-6)
    assert curves["hidden"].tolist() == hidden.astype(int).tolist()
    assert curves.attrs["masks"] == str(len(MASKS))


def test_table2_sets_the_paper_beside_ours(plan, by_opencv):
    (table,) = made("table2", plan)
    table = table.set_index(["measure", "frames", "sd_over"])
    assert list(table.loc[("overlap", "all", "runs"), ["paper_camshift_mean", "paper_camshift_sd"]]) == [0.53, 0.06]
    assert list(table.loc[("overlap", "all", "runs"), ["paper_color-pf_mean", "paper_color-pf_sd"]]) == [0.62, 0.10]
    assert list(table.loc[("hit_ratio", "all", "runs"), ["paper_camshift_mean", "paper_color-pf_mean"]]) == [0.79, 0.87]
    assert list(table.loc[("ms_per_frame", "all", "runs"), ["paper_camshift_mean", "paper_color-pf_mean"]]) == [
        0.73,
        5.55,
    ]
    assert table.loc[("iterations", "all", "runs"), "paper_camshift_mean"] == 1.90

    every = [scores(n_particles=100, seed=seed) for seed in range(3)]
    for measure in ("overlap", "hit_ratio"):
        for frames in ("all", "visible"):
            values = [getattr(score, f"{measure}_{frames}") for score in every]
            row = table.loc[(measure, frames, "runs")]
            assert row["color-pf_mean"] == pytest.approx(np.mean(values), abs=0.51e-6)
            assert row["color-pf_sd"] == pytest.approx(np.std(values, ddof=1), abs=0.51e-6)
    visible = np.array([overlaps(seed) for seed in range(3)])[:, ~np.isnan(scene().boxes[:, 0])]
    row = table.loc[("overlap", "visible", "band"), "color-pf_sd"]
    assert row == pytest.approx(visible.std(axis=0, ddof=1).mean(), abs=0.51e-6)
    row = table.loc[("overlap", "visible", "frames"), "color-pf_sd"]
    assert row == pytest.approx(visible.std(axis=1, ddof=1).mean(), abs=0.51e-6)

    floor = metrics.single_target(np.tile(scene().boxes[0], (N_FRAMES, 1)), scene().boxes)
    assert table.loc[("overlap", "all", "runs"), "floor_mean"] == pytest.approx(floor.overlap_all, abs=0.51e-6)
    assert table.loc[("hit_ratio", "visible", "runs"), "floor_mean"] == pytest.approx(
        floor.hit_ratio_visible, abs=0.51e-6
    )

    for tracker, (rates, iterations) in by_opencv.items():
        counted = np.nan_to_num(rates)
        best = np.argsort(-counted.mean(axis=1), stable=True)[:3]
        row = table.loc[("overlap", "all", "runs")]
        assert row[f"{tracker}_mean"] == pytest.approx(counted[best].mean(), abs=0.51e-6)
        assert row[f"{tracker}_sd"] == pytest.approx(counted[best].mean(axis=1).std(ddof=1), abs=0.51e-6)
        row = table.loc[("iterations", "all", "runs")]
        assert row[f"{tracker}_mean"] == pytest.approx(iterations[best, 1:].mean(), abs=0.51e-6)
        assert table.loc[("ms_per_frame", "all", "runs"), f"{tracker}_mean"] > 0
    assert "ms_per_frame" in table.index.get_level_values("measure")
    assert table.index.is_unique


def test_items_share_their_runs_and_go_on_where_they_stopped(plan, monkeypatch):
    made("fig6b", plan)
    monkeypatch.setattr(experiments, "_run_group", lambda *_: pytest.fail("computed again"))
    first = made("fig6b", plan)[0]
    table = made("table2", plan)[0].set_index(["measure", "frames", "sd_over"])
    assert table.loc[("overlap", "visible", "runs"), "color-pf_mean"] == pytest.approx(first["mean"].mean(), abs=1e-6)


def test_sensitivity_varies_one_setting_at_a_time():
    default = experiments.Run("color-pf", SCENE, 0).all_settings
    tried = reproduce.variations()
    names = {name for name, *_ in tried}
    assert {"sigma", "resample_threshold", "lost_distance", "scale_range"} < names
    assert {"position noise", "velocity noise", "scale noise"} < names
    for name in names:
        changes = [settings for other, _, settings in tried if other == name]
        assert len(changes) >= 4
        assert len({json.dumps(settings) for settings in changes}) == len(changes)
        at_default = [settings for settings in changes if default | settings == default]
        assert len(at_default) == 1
    for name, factor, settings in tried:
        assert len(settings) == 1
        if name.endswith("noise"):
            ratio = np.divide(settings["noise"], default["noise"])
            places = {"position noise": [0, 1], "velocity noise": [2, 3], "scale noise": [4]}[name]
            assert ratio == pytest.approx([factor if place in places else 1 for place in range(5)])
        else:
            assert settings == {name: factor}
        experiments.Run("color-pf", SCENE, 0, settings).make_tracker()  # every value is allowed


def test_sensitivity_has_the_mean_and_spread_of_every_value(plan, monkeypatch):
    tried = [
        ("sigma", 0.1, {"sigma": 0.1}),
        ("sigma", 0.2, {"sigma": 0.2}),
        ("lost_distance", 0.5, {"lost_distance": 0.5}),
    ]
    monkeypatch.setattr(reproduce.one, "variations", lambda: tried)
    (table,) = made("sensitivity", plan)
    assert table["setting"].tolist() == ["sigma", "sigma", "lost_distance"]
    assert table["value"].tolist() == [0.1, 0.2, 0.5]
    assert table["default"].tolist() == [1, 0, 1]
    for (_, row), sigma in zip(table.iterrows(), (0.1, 0.2, 0.1), strict=True):
        values = [scores(sigma=sigma, seed=seed).overlap_all for seed in range(3)]
        assert row["overlap_all_mean"] == pytest.approx(np.mean(values), abs=0.51e-6)
        assert row["overlap_all_sd"] == pytest.approx(np.std(values, ddof=1), abs=0.51e-6)
    assert table.attrs["sigma"] == "0.1"


# ---------------------------------------------------------------------------------------------------------------------
# The command
# ---------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def items(monkeypatch):
    """Items that only note the plan they get."""
    plans = []

    def item(name):
        def write(plan):
            plans.append((name, plan))
            return [plan.results / f"{name}.csv"]

        return write

    monkeypatch.setattr(reproduce, "ITEMS", {name: item(name) for name in reproduce.ITEMS})
    return plans


def run(*arguments) -> int:
    try:
        return main(["reproduce", *map(str, arguments)])
    except SystemExit as error:
        return error.code


def test_the_command_does_what_it_is_told(items, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("fig3", "--results", tmp_path / "a" / "b", "--runs", 7, "--jobs", 1) == 0
    ((name, plan),) = items
    assert (name, plan.results, plan.n_runs, plan.n_jobs) == ("fig3", tmp_path / "a" / "b", 7, 1)
    assert capfd.readouterr() == (f"{tmp_path / 'a' / 'b' / 'fig3.csv'}\n", "")
    items.clear()
    assert run() == 0
    assert {name for name, _ in items} >= {"fig3", "fig6a", "fig6b", "table2", "sensitivity"}
    assert items[0][1] == Plan(progress=items[0][1].progress)
    assert "results/fig6b.csv" in capfd.readouterr().out.replace("\\", "/")


def test_the_help_names_every_item(capfd):
    assert run("--help") == 0
    shown = capfd.readouterr().out
    assert all(name in shown for name in reproduce.ITEMS)


def test_work_is_kept_in_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.setattr(registry, "cache_folder", lambda: tmp_path / "cache")
    assert tmp_path / "cache" in Plan().folder.parents


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["fig9"], "unknown item 'fig9'; choose one of .*table2"),
        (["fig3", "--runs", 0], "number of runs must be at least 1"),
        (["fig3", "--runs", "many"], "invalid int value"),
        (["fig6b", "--jobs", 0], "n_jobs"),
        (["fig3", "--results", __file__], "test_reproduce"),
    ],
)
def test_a_bad_command_is_one_line(arguments, hint, plan, capfd, monkeypatch, tmp_path):
    monkeypatch.setattr(registry, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    output, errors = capfd.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    assert re.search(hint, errors)


@pytest.mark.parametrize(
    ("error", "status", "hint"),
    [
        (KeyboardInterrupt(), 130, "interrupted; what was finished is kept, and the same command goes on from there"),
        (BrokenExecutor("gone"), 2, "want of memory; what was finished is kept"),
    ],
)
def test_an_interruption_says_that_work_is_kept(error, status, hint, monkeypatch, tmp_path, capfd):
    def stop(plan):
        raise error

    monkeypatch.setitem(reproduce.ITEMS, "fig3", stop)
    assert run("fig3", "--results", tmp_path) == status
    errors = capfd.readouterr().err
    assert len(errors.splitlines()) == 1
    assert hint in errors


def test_the_command_reproduces_on_the_papers_own_footage(footage, monkeypatch, tmp_path, capfd):
    sequence = footage("bobot-I")
    monkeypatch.setattr(registry, "cache_folder", lambda: tmp_path / "cache")
    assert run("fig6b", "--runs", 1, "--jobs", 1, "--results", tmp_path) == 0
    table = reproduce.read(tmp_path / "fig6b.csv")
    assert len(table) == 1017  # Table I of the paper
    assert table["hidden"].sum() == 23
    tracker = pftrack.ColorParticleFilter(n_particles=100, seed=0)
    boxes = pftrack.track(tracker, sequence.frames[:50], sequence.boxes[0])
    np.testing.assert_allclose(table["mean"][:50], metrics.overlap(boxes, sequence.boxes[:50]), atol=0.51e-6)


# ---------------------------------------------------------------------------------------------------------------------
# Many pedestrians
# ---------------------------------------------------------------------------------------------------------------------


def test_each_detector_is_scored_over_the_whole_film(plan, monkeypatch):
    rows = [("plain", {"background": "difference", **many.PLAIN}), ("+ size prior", {"background": "difference"})]
    monkeypatch.setattr(many, "detectors", lambda: rows)
    (table,) = made("detection", plan)
    assert table["detector"].tolist() == ["plain", "+ size prior"]
    for (_, settings), row in zip(rows, table.to_dict("records"), strict=True):
        found = detection.detect(scene().frames, detection.PedestrianDetector(**settings))
        score = metrics.detections(found, scene().tracks)
        assert row["n_found"] == score.n_found
        np.testing.assert_allclose([row["recall"], row["precision"]], [score.recall, score.precision], atol=1e-6)
    assert (table["ms"] > 0).all()
    assert table["ms"].nunique() == 1  # the windows are the same
    assert int(table.attrs["boxes"]) == len(scene().tracks)


def test_steps_lead_from_the_paper_to_the_default():
    for steps, first, kind in [
        (many.bof_steps(), many.LITERAL, pftrack.BagOfFeaturesParticleFilter),
        (many.detectors()[6:], many.PLAIN, pftrack.PedestrianDetector),
    ]:
        assert steps[0][1] == first
        assert {} in [settings for _, settings in steps]
        for (_, before), (_, after) in itertools.pairwise(steps[: len(first) + 1]):
            assert len(before) == len(after) + 1
            assert after.items() <= before.items()
        for _, settings in steps:
            kind(**settings)


def test_the_errors_of_the_bag_of_features_filter_are_those_of_its_runs(plan, monkeypatch):
    plan = dataclasses.replace(plan, n_runs=2)
    monkeypatch.setattr(many, "bof_steps", lambda: [("all", {}), ("fixed", {"adapt_weights": False})])
    monkeypatch.setattr(many, "AT_MOST", 40)
    whole, ablation = made("bof", plan)
    known = whole[whole["known"]]
    for seed in (0, 1):
        tracker = pftrack.BagOfFeaturesParticleFilter(seed=seed)
        tracker.init(list(scene().frames[:5]), scene().boxes[:5, None])
        tracks = list(pftrack.multi.follow(tracker, scene().frames[5:]))
        errors = metrics.center_error([track.box for (track,) in tracks], scene().boxes[5:])
        row = known[known["seed"] == seed].iloc[0]
        assert row["center_error"] == pytest.approx(np.nanmean(errors), abs=1e-5)
        assert row["frames"] == np.isfinite(errors).sum()
        assert row["swapped"] == 0
    assert ablation["setting"].tolist() == ["all", "fixed"]
    assert (ablation["runs"] == 2).all()
    assert (ablation["swaps"] == 0).all()
    assert ablation["center_error_mean"].iloc[0] != ablation["center_error_mean"].iloc[1]


# ---------------------------------------------------------------------------------------------------------------------
# The comparison
# ---------------------------------------------------------------------------------------------------------------------


def walk(*places) -> np.ndarray:
    """Boxes 10 wide and 20 high with their left edges at some places; nowhere at NaN."""
    return np.array([[x, 0.0, 10.0, 20.0] if np.isfinite(x) else [np.nan] * 4 for x in places])


GONE = float("nan")


def test_a_track_that_ends_keeps_its_last_box_and_so_does_one_that_pauses():
    truth = walk(0, 2, 4, 6, 8, 10)[:, None]
    found = rivals.score(walk(0, 3, GONE, 6, GONE, GONE), 0, truth, begin=1, n_last=20)
    assert found["center_error"] == pytest.approx(np.mean([1, 1, 0, 2, 4]))
    assert found["frames"] == 5
    assert found["reported"] == pytest.approx(2 / 5)
    assert found["right"] == pytest.approx(2 / 5)
    assert found["swapped"] == 0


def test_a_track_that_never_was_stays_where_the_target_was_last_shown():
    truth = walk(0, 2, 4, 6)[:, None]
    found = rivals.score(walk(*[GONE] * 4), 0, truth, begin=2, n_last=20)
    assert found["center_error"] == pytest.approx(np.mean([2, 4]))
    assert (found["frames"], found["reported"], found["right"]) == (2, 0, 0)
    assert np.isnan(found["swapped"])


def test_only_frames_after_the_training_in_which_the_target_is_seen_are_compared():
    truth = walk(0, 0, 0, GONE, 0)[:, None]
    found = rivals.score(walk(50, 50, 3, 90, 4), 0, truth, begin=2, n_last=20)
    assert found["center_error"] == pytest.approx(3.5)
    assert found["frames"] == 2
    assert found["reported"] == 1
    assert found["right"] == pytest.approx(1 / 2)  # 3 off, 70 of 130 pixels overlap; 4 off, 60 of 140


def test_a_track_is_swapped_when_it_ends_nearer_to_another():
    one, other = walk(0, 10, 20, 30, 40), walk(40, 30, 20, 10, 0)
    truth = np.stack([one, other], axis=1)
    assert many.swapped(one, 0, truth, n_last=2) == 0
    assert many.swapped(one, 1, truth, n_last=2) == 1
    assert many.swapped(other, 0, truth, n_last=2) == 1
    early = np.where(np.arange(5)[:, None] < 2, one, np.nan)
    assert many.swapped(early, 0, truth, n_last=2) == 0  # it ended before they met
    truth[3:, 1] = np.nan
    assert many.swapped(other, 0, truth, n_last=2) == 0  # nobody was there any more


def test_those_seen_in_all_training_frames_are_followed_until_the_last_leaves():
    rows = [
        [t, id, 0, 0, 10, 20, 1] for id, frames in {3: [0, 1, 2, 5], 4: [0, 1], 5: [1, 2, 3]}.items() for t in frames
    ]
    film = dataclasses.replace(scene(), tracks=np.array(rows, dtype=float))
    targets, truth = many.seen_in_training(film, n_training=2)
    assert targets == [3, 4]
    assert np.isfinite(truth[:, :, 0]).tolist() == [[True, True]] * 2 + [[t in (2, 5), False] for t in range(2, 6)]
    assert len(many.seen_in_training(film, 2, at_most=5)[1]) == 3


@functools.cache
def pair(id: str) -> datasets.Sequence:
    """A short scene of two walkers, under any name."""
    return dataclasses.replace(datasets.synthetic.scene(n_frames=9, n_walkers=2), name=id)


def by_hand(name: str, film: datasets.Sequence, table: np.ndarray) -> np.ndarray:
    """Boxes that a tracker with seed 0 finds of both walkers in the last four frames, shape (4, 2, 4)."""
    truth = np.stack([film.target(1), film.target(2)], axis=1)
    frames = list(film.frames)
    if name == "superpixel":
        trackers = [pftrack.SuperpixelTracker(seed=0) for _ in range(2)]
        for n, tracker in enumerate(trackers):
            tracker.init_from(frames[:5], truth[:5, n])
        return np.array([[tracker.update(frame).box for tracker in trackers] for frame in frames[5:]])
    if name == "association-pf":
        tracker = pftrack.AssociationParticleFilter(seed=0)
        tracker.init(frames[:5], truth[:5])
        known = [1, 2]
    else:
        tracker = pftrack.BoostedParticleFilter(seed=0)
        for frame, boxes in zip(frames[:5], truth[:5], strict=True):
            first = tracker.update(frame, [[*box, 5.0] for box in boxes])
        assert len(first) == 2
        alike = metrics.pairwise_overlap(truth[4], [track.box for track in first])
        known = [first[n].id for n in alike.argmax(axis=1)]
    boxes = []
    for t, frame in enumerate(frames[5:], start=5):
        detections = None if "AdaBoost" in name else table[table[:, 0] == t, 2:]
        found = {track.id: track.box for track in tracker.update(frame, detections)}
        boxes.append([found.get(id, np.full(4, np.nan)) for id in known])
    return np.array(boxes)


def test_the_comparison_is_that_of_runs_made_by_hand(plan, monkeypatch):
    monkeypatch.setattr(datasets, "load", lambda id, progress=True: pair(id))
    slow = {"bof-pf", "association-pf (as printed)"}
    quick = {name: tracker for name, tracker in rivals.TRACKERS.items() if name not in slow}
    monkeypatch.setattr(rivals, "TRACKERS", quick)
    plan = dataclasses.replace(plan, n_runs=1, followed=("one",))
    (table,) = made("comparison", plan)
    assert list(table["sequence"].unique()) == ["one", "one (dimmed)", rivals.DRAWN]
    assert len(table) == 3 * len(rivals.TRACKERS) * 2
    assert table.attrs["sequence"] == f"one, one (dimmed), {rivals.DRAWN}"
    drawn = datasets.synthetic.draw_detections(pair("any"))
    for film in (pair("one").dimmed(0.6), pair(rivals.DRAWN)):
        found = drawn if film.name == rivals.DRAWN else detection.detect(film.frames)
        for name in rivals.TRACKERS:
            boxes = by_hand(name, film, found)
            rows = table[(table["sequence"] == film.name) & (table["tracker"] == name)]
            assert rows["target"].tolist() == [1, 2]
            for n, row in enumerate(rows.to_dict("records")):
                true = film.target(n + 1)[5:]
                there = np.isfinite(boxes[:, n, 0])
                assert row["reported"] == pytest.approx(there.mean())
                assert row["right"] == pytest.approx((metrics.overlap(boxes[:, n], true) >= 0.5).mean())
                assert row["frames"] == 4
                if there.all():
                    errors = metrics.center_error(boxes[:, n], true)
                    assert row["center_error"] == pytest.approx(errors.mean(), abs=1e-5)


def test_the_comparison_takes_from_its_store_what_depends_on_nothing_new(plan, monkeypatch):
    monkeypatch.setattr(datasets, "load", lambda id, progress=True: pair(id))
    plan = dataclasses.replace(plan, n_runs=1, followed=("one",))
    settings = {"n_particles": 20}
    monkeypatch.setattr(rivals, "TRACKERS", {"boosted-pf": (pftrack.BoostedParticleFilter, settings, "HOG")})
    (first,) = made("comparison", plan)
    monkeypatch.setattr(rivals, "TRACKERS", {"boosted-pf": (None, settings, "HOG")})  # nothing that could run
    pd.testing.assert_frame_equal(made("comparison", plan)[0], first)
    for name, value in {"CERTAIN": 4.0, "N_TRAINING": 4, "DIMMED": 0.5, "AT_MOST": {"one": 8}}.items():
        with monkeypatch.context() as patch:
            patch.setattr(rivals, name, value)
            with pytest.raises(TypeError, match="NoneType"):
                made("comparison", plan)


def test_the_printed_tables_have_a_number_for_every_pedestrian_and_tracker():
    lengths = {table: {len(errors) for errors in rows.values()} for table, rows in reproduce.PRINTED.items()}
    assert lengths == {"Table 3": {3}, "Table 4": {5}, "Table 5": {3}}
    assert {tuple(rows) for rows in reproduce.PRINTED.values()} == {("superpixel", "boosted-pf", "association-pf")}
    assert set(reproduce.PRINTED["Table 3"]) < set(rivals.TRACKERS)


# ---------------------------------------------------------------------------------------------------------------------
# The association filter on whole films
# ---------------------------------------------------------------------------------------------------------------------


def test_the_association_filter_is_scored_as_by_hand(plan, monkeypatch):
    film = pair("one")
    film = dataclasses.replace(film, detections=datasets.synthetic.draw_detections(film))
    monkeypatch.setattr(datasets, "load", lambda id, progress=True: film)
    monkeypatch.setattr(crowd, "PUBLISHED_SCORE", {"one": 0.5})
    plan = dataclasses.replace(plan, n_runs=2, followed=("one",))
    runs, ablation = made("association", plan)
    n_seeds = {("own", "default"): 2, ("own", "as printed"): min(2, crowd.N_PRINTED), ("published", "default"): 2}
    kinds = [kind for kind, n in n_seeds.items() for _ in range(n)]
    assert list(zip(runs["detections"], runs["form"], strict=True)) == kinds
    assert (runs["n_truth"] == len(film.tracks)).all()
    for row in runs[runs["detections"] == "published"].to_dict("records"):
        tracker = pftrack.AssociationParticleFilter(seed=row["seed"], birth_score=0.5)
        tracks = multi.table(multi.follow(tracker, film.frames, film.detections))
        expected = metrics.multi_target(tracks, film.tracks)
        assert expected.n_matched > 0
        assert [row["mota"], row["idf1"], row["n_matched"]] == pytest.approx(
            [expected.mota, expected.idf1, expected.n_matched], abs=1e-5
        )
    assert ablation["left_out"].tolist() == ["nothing", *association.ADDITIONS]
    assert (ablation["runs"] == 2).all()


def test_one_addition_is_left_out_at_a_time():
    for name, settings in reproduce.association_steps()[1:]:
        assert set(association.ADDITIONS) - set(settings["additions"]) == {name}
