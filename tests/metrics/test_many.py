"""Detections and the tracks of many, against cases worked out by hand, enumeration, and published scores."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from pftrack import metrics
from pftrack.datasets import readers


def row(frame, id, x, y=0, w=10, h=20):
    return [frame, id, x, y, w, h, 1]


# ---------------------------------------------------------------------------------------------------------------------
# Detections, and which track is whom
# ---------------------------------------------------------------------------------------------------------------------


def test_detections_pair_one_to_one():
    truth = [row(0, 1, 0), row(0, 2, 100), row(1, 1, 0), row(3, 1, 0)]
    found = [row(0, -1, 0), row(0, -1, 1), row(0, -1, 50), row(1, -1, 4), row(2, -1, 0)]
    score = metrics.detections(found, truth)
    assert (score.n_truth, score.n_found, score.n_matched) == (4, 5, 1)  # 4 of 10 pixels beside overlap by 3/7
    assert (score.recall, score.precision, score.overlap) == (0.25, 0.2, 1.0)
    assert metrics.detections(found, truth, min_overlap=0.4).n_matched == 2


def test_detections_pair_for_the_largest_sum():
    truth, found = [row(0, 1, 0), row(0, 2, 6)], [row(0, -1, 3), row(0, -1, -3)]
    assert metrics.detections(found, truth, min_overlap=0.5).n_matched == 2


def test_of_nothing_there_is_no_share():
    score = metrics.detections(np.empty((0, 7)), [row(0, 1, 0)])
    assert (score.recall, score.n_matched) == (0, 0)
    assert np.isnan([score.precision, score.overlap]).all()
    assert np.isnan(metrics.detections([row(0, -1, 0)], []).recall)


def test_which_detections_are_right():
    truth = [row(0, 1, 0), row(0, 2, 100), row(1, 1, 0)]
    found = [row(1, -1, 1), row(0, -1, 101), row(0, -1, 1), row(0, -1, 0), row(2, -1, 0), row(0, -1, 106)]
    np.testing.assert_array_equal(metrics.correct(found, truth), [True, True, False, True, False, False])
    assert metrics.correct([], truth).shape == (0,)
    assert not metrics.correct(found, []).any()


def test_the_score_counts_the_detections_that_are_right():
    rng = np.random.default_rng(5)
    truth, found = ([row(t, -1, *rng.uniform(0, 40, 2)) for t in rng.integers(0, 30, 90)] for _ in range(2))
    right = metrics.correct(found, truth, min_overlap=0.3)
    score = metrics.detections(found, truth, min_overlap=0.3)
    assert score.n_matched == right.sum() > 10
    assert score.precision == pytest.approx(right.mean())
    again = metrics.detections(np.array(found)[right], truth, min_overlap=0.3)
    assert (again.n_matched, again.precision) == (right.sum(), 1)
    assert again.overlap == pytest.approx(score.overlap)


def test_tracks_are_matched_in_one_frame():
    truth = [row(5, 11, 0), row(5, 12, 8), row(5, 13, 200), row(6, 11, 300)]
    tracks = [row(5, 1, 7), row(5, 2, 1), row(5, 3, 300), row(6, 4, 300)]
    assert metrics.match_targets(tracks, truth, frame=5) == {11: 2, 12: 1}
    assert metrics.match_targets(tracks, truth, frame=7) == {}
    assert metrics.match_targets(tracks, truth, frame=5, min_overlap=0.9) == {}


# ---------------------------------------------------------------------------------------------------------------------
# Tracks: cases worked out by hand
# ---------------------------------------------------------------------------------------------------------------------


def walk(id, frames, place=0, **size):
    """Rows of somebody who walks along a lane of their own."""
    return [row(t, id, 100 * place + 3 * t, **size) for t in frames]


TEN = range(10)
ONE, BOTH = walk(1, TEN), walk(1, TEN) + walk(2, TEN, place=1)
GOOD = {"mota": 1, "motp": 1, "idf1": 1, "id_precision": 1, "id_recall": 1, "hota": 1, "deta": 1, "assa": 1}
NO_ERRORS = {"misses": 0, "false_positives": 0, "switches": 0, "fragments": 0}

CASES = {
    "perfect": (BOTH, BOTH, GOOD | NO_ERRORS | {"mostly_tracked": 2, "n_matched": 20}),
    "swapped half-way": (
        walk(1, range(5)) + walk(2, range(5, 10)) + walk(2, range(5), place=1) + walk(1, range(5, 10), place=1),
        BOTH,
        # every pair shares 5 boxes, of 10 and 10
        GOOD
        | NO_ERRORS
        | {"switches": 2, "mota": 0.9, "assa": 1 / 3, "hota": np.sqrt(1 / 3)}
        | dict.fromkeys(("idf1", "id_precision", "id_recall"), 0.5),
    ),
    "handed over": (
        walk(1, range(5)) + walk(2, range(5, 10)),
        ONE,
        {"switches": 1, "fragments": 0, "mota": 0.9, "idf1": 0.5, "deta": 1, "assa": 0.5, "hota": np.sqrt(0.5)},
    ),
    "a gap": (
        walk(1, [0, 1, 2, 3, 6, 7, 8, 9]) + walk(9, [4, 5], place=3),
        ONE,
        {"misses": 2, "false_positives": 2, "switches": 0, "fragments": 1, "mota": 0.6, "idf1": 16 / 20}
        | {"deta": 8 / 12, "assa": 8 / 10, "partly_tracked": 1, "mostly_tracked": 0},  # 80 % is not more than 80 %
    ),
    "a gap, then another": (
        walk(1, range(4)) + walk(9, [4], place=3) + walk(2, range(5, 10)),
        ONE,
        {"misses": 1, "switches": 1, "fragments": 1, "mota": 0.7, "mostly_tracked": 1, "idf1": 10 / 20},
    ),
    "a ghost": (
        ONE + walk(2, range(4), place=1),
        ONE,
        GOOD
        | NO_ERRORS
        | {"false_positives": 4, "mota": 0.6, "idf1": 20 / 24, "id_precision": 10 / 14}
        | {"deta": 10 / 14, "hota": np.sqrt(10 / 14), "n_tracks": 2, "n_targets": 1},
    ),
    "one followed twice": (
        ONE + walk(2, TEN),
        ONE,
        {"false_positives": 10, "switches": 0, "mota": 0, "motp": 1, "idf1": 2 / 3, "deta": 0.5, "assa": 1},
    ),
    "seldom found": (walk(1, [3]), ONE, {"mostly_lost": 1, "partly_tracked": 0, "id_precision": 1, "id_recall": 0.1}),
    "found in one frame of five": (walk(1, [3, 4]), ONE, {"mostly_lost": 0, "partly_tracked": 1}),
    "overlap of exactly 0.75": (
        walk(1, TEN, h=15),
        ONE,
        GOOD | NO_ERRORS | {"motp": 0.75} | dict.fromkeys(("hota", "deta", "assa"), 15 / 19),
    ),
    "overlap of exactly 0.5": (walk(1, TEN, h=10), ONE, {"mota": 1, "motp": 0.5, "idf1": 1, "hota": 10 / 19}),
    "overlap of less": (
        walk(1, TEN, h=9),
        ONE,
        {"misses": 10, "false_positives": 10, "mota": -1, "motp": np.nan, "idf1": 0, "hota": 9 / 19, "mostly_lost": 1},
    ),
    "a pair is kept though another fits better": (
        [row(0, 1, 0), row(1, 1, 0, h=12), row(1, 2, 0)],
        [row(0, 1, 0), row(1, 1, 0)],
        {"switches": 0, "false_positives": 1, "motp": (1 + 0.6) / 2},
    ),
    "and over frames in which nothing is found": (
        [row(0, 1, 0), row(2, 1, 0, h=12), row(2, 2, 0)],
        [row(0, 1, 0), row(1, 1, 0), row(2, 1, 0)],
        {"switches": 0, "fragments": 0, "misses": 1, "motp": (1 + 0.6) / 2},
    ),
    "but not over others": (
        [row(0, 1, 0), row(1, 3, 500), row(2, 1, 0, h=12), row(2, 2, 0)],
        [row(0, 1, 0), row(1, 1, 0), row(2, 1, 0)],
        {"switches": 1, "fragments": 1, "misses": 1, "motp": 1},
    ),
}


@pytest.mark.parametrize(("tracks", "truth", "expected"), CASES.values(), ids=CASES.keys())
def test_multi_target_worked_out_by_hand(tracks, truth, expected):
    score = metrics.multi_target(tracks, truth).as_dict()
    assert {name: score[name] for name in expected} == pytest.approx(expected, nan_ok=True)


def test_the_threshold_is_that_of_clear_and_identity_not_of_hota():
    strict, usual = (metrics.multi_target(walk(1, TEN, h=15), ONE, min_overlap) for min_overlap in (0.8, 0.5))
    assert (strict.mota, strict.idf1, strict.n_matched) == (-1, 0, 0)
    assert (usual.mota, usual.idf1, usual.n_matched) == (1, 1, 10)
    assert strict.hota == usual.hota


def test_frames_are_those_with_a_box():
    score = metrics.multi_target(walk(1, [3, 4]), walk(1, [4, 5, 900]))
    assert (score.n_frames, score.n_truth, score.n_found, score.misses, score.false_positives) == (4, 3, 2, 2, 1)


def test_of_no_tracks_everything_is_missed():
    score = metrics.multi_target([], BOTH)
    assert (score.misses, score.mostly_lost, score.n_tracks, score.switches, score.fragments) == (20, 2, 0, 0, 0)
    assert (score.mota, score.idf1, score.id_recall, score.hota, score.deta, score.assa) == (0, 0, 0, 0, 0, 0)
    assert np.isnan([score.motp, score.id_precision]).all()


def test_of_no_truth_everything_is_a_false_positive():
    score = metrics.multi_target(BOTH, np.empty((0, 7)))
    assert (score.false_positives, score.n_targets, score.mostly_lost) == (20, 0, 0)
    assert (score.idf1, score.id_precision, score.hota, score.deta, score.assa) == (0, 0, 0, 0, 0)
    assert np.isnan([score.mota, score.motp, score.id_recall]).all()


def test_of_nothing_there_is_no_score():
    score = metrics.multi_target([], [])
    assert (score.n_frames, score.misses, score.false_positives) == (0, 0, 0)
    assert np.isnan([score.mota, score.motp, score.idf1, score.hota, score.deta]).all()


def test_a_multi_target_score_turns_into_json():
    score = metrics.multi_target(walk(1, range(4)), BOTH)
    assert metrics.MultiTargetScore(**json.loads(json.dumps(score.as_dict()))) == score


BAD_TABLES = {
    "five columns": ([[0, 1, 2, 3, 4]], r"shape \(R, 7\), got \(1, 5\)"),
    "one row alone": (row(0, 1, 0), r"shape \(R, 7\), got \(7,\)"),
    "seven rows of another shape": (np.ones((7, 2)), r"shape \(R, 7\)"),
    "no width": ([row(0, 1, 0, w=np.nan)], "not finite"),
    "a negative height": ([row(0, 1, 0, h=-20)], "negative side"),
}
BAD_TRACKS = {
    "an id twice": (ONE + [row(4, 1, 500)], "id 1 twice in frame 4"),
    "half an id": ([row(0, 1.5, 0)], "no whole number"),
    "half a frame": ([row(0.5, 1, 0)], "no whole number"),
}


@pytest.mark.parametrize(("bad", "hint"), (BAD_TABLES | BAD_TRACKS).values(), ids=(BAD_TABLES | BAD_TRACKS).keys())
def test_tables_of_tracks_that_make_no_sense_are_rejected(bad, hint):
    with pytest.raises(ValueError, match=f"^the table of tracks .*{hint}"):
        metrics.multi_target(bad, ONE)
    with pytest.raises(ValueError, match=f"^the truth .*{hint}"):
        metrics.multi_target(ONE, bad)


@pytest.mark.parametrize(("bad", "hint"), BAD_TABLES.values(), ids=BAD_TABLES.keys())
@pytest.mark.parametrize("measure", [metrics.detections, metrics.correct])
def test_tables_of_detections_that_make_no_sense_are_rejected(measure, bad, hint):
    with pytest.raises(ValueError, match=f"^the table of detections .*{hint}"):
        measure(bad, ONE)
    with pytest.raises(ValueError, match=f"^the truth .*{hint}"):
        measure(ONE, bad)


@pytest.mark.parametrize("measure", [metrics.detections, metrics.correct, metrics.multi_target])
@pytest.mark.parametrize("min_overlap", [0, -0.5, 1.1, np.nan])
def test_a_least_overlap_that_makes_no_sense_is_rejected(measure, min_overlap):
    with pytest.raises(ValueError, match="above 0 and at most 1"):
        measure(ONE, ONE, min_overlap)


# ---------------------------------------------------------------------------------------------------------------------
# Tracks: enumeration
# ---------------------------------------------------------------------------------------------------------------------


def random_tracks(seed, n_targets=3, n_frames=7):
    """Tracks of a few people close together, with errors of every kind, and the truth."""
    rng = np.random.default_rng(seed)
    x, names, tracks, truth = rng.uniform(0, 20, n_targets), rng.permutation(n_targets), [], []
    for t in range(n_frames):
        x = x + rng.normal(0, 2, n_targets)
        names = rng.permutation(n_targets) if rng.random() < 0.2 else names
        truth += [row(t, 10 + n, x[n]) for n in range(n_targets) if rng.random() < 0.8]
        tracks += [
            row(t, 70 + names[n], *(x[n], 0) + rng.normal(0, 2, 2)) for n in range(n_targets) if rng.random() < 0.8
        ]
    return np.array(tracks), np.array(truth)


def best(worth):
    """The pairs, one to one, that are worth most together, by trying all."""
    if not worth:
        return []
    pair, *others = worth
    apart = [other for other in others if other[0] != pair[0] and other[1] != pair[1]]
    choices = [pair, *best({other: worth[other] for other in apart})], best({other: worth[other] for other in others})
    return max(choices, key=lambda pairs: sum(worth[one] for one in pairs))


def overlaps_by_frame(tracks, truth):
    """For every frame that has both, the overlap of each target with each track, by their ids."""
    frames = sorted(set(truth[:, 0]) & set(tracks[:, 0]))
    boxes = [(truth[truth[:, 0] == t], tracks[tracks[:, 0] == t]) for t in frames]
    return [
        {(a[1], b[1]): metrics.overlap([a[2:6]], [b[2:6]])[0] for a in here for b in there} for here, there in boxes
    ]


def clear_by_counting(tracks, truth):
    before, latest, switches, overlaps = [], {}, 0, []
    for rates in overlaps_by_frame(tracks, truth):
        before = best({pair: rate + 10 * (pair in before) for pair, rate in rates.items() if rate >= 0.5})
        switches += sum(latest.get(target, track) != track for target, track in before)
        latest |= dict(before)
        overlaps += [rates[pair] for pair in before]
    misses, false_positives = len(truth) - len(overlaps), len(tracks) - len(overlaps)
    mota = 1 - (misses + false_positives + switches) / len(truth)
    counts = {"misses": misses, "false_positives": false_positives, "switches": switches}
    return counts | {"mota": mota, "motp": np.mean(overlaps)}


def identity_by_counting(tracks, truth):
    close = [pair for rates in overlaps_by_frame(tracks, truth) for pair, rate in rates.items() if rate >= 0.5]
    right = sum(map(close.count, best({pair: close.count(pair) for pair in close})))
    idf1 = 2 * right / (len(truth) + len(tracks))
    return {"idf1": idf1, "id_precision": right / len(tracks), "id_recall": right / len(truth)}


def hota_by_counting(tracks, truth):
    frames, belonging, pairs = overlaps_by_frame(tracks, truth), {}, []
    n_boxes = {pair: sum(truth[:, 1] == pair[0]) + sum(tracks[:, 1] == pair[1]) for rates in frames for pair in rates}
    for pair in n_boxes:
        shared = 0
        for rates in frames:
            touching = sum(rate for (i, j), rate in rates.items() if i == pair[0] or j == pair[1])
            shared += rates.get(pair, 0) / touching if touching > 0 else 0
        belonging[pair] = shared / (n_boxes[pair] - shared)
    for rates in frames:
        pairs += [(pair, rates[pair]) for pair in best({one: belonging[one] * rates[one] for one in rates})]
    scores = []
    for threshold in np.linspace(0.05, 0.95, 19):
        close = [pair for pair, rate in pairs if rate >= threshold]
        shares = [close.count(pair) / (n_boxes[pair] - close.count(pair)) for pair in close]
        deta, assa = len(close) / (len(truth) + len(tracks) - len(close)), np.mean(shares or [0])
        scores.append([np.sqrt(deta * assa), deta, assa])
    return dict(zip(("hota", "deta", "assa"), np.mean(scores, axis=0), strict=True))


@pytest.mark.parametrize("by_counting", [clear_by_counting, identity_by_counting, hota_by_counting])
def test_multi_target_is_what_trying_all_pairs_and_counting_gives(by_counting):
    switches, worst = 0, 1.0
    for seed in range(60):
        tracks, truth = random_tracks(seed)
        score = metrics.multi_target(tracks, truth).as_dict()
        expected = by_counting(tracks, truth)
        assert {name: score[name] for name in expected} == pytest.approx(expected), f"seed {seed}"
        switches, worst = switches + score["switches"], min(worst, score["idf1"])
    assert switches > 60  # the scenes are as hard as they should be
    assert worst < 0.4


@pytest.mark.parametrize("seed", range(5))
def test_only_who_is_who_matters_not_what_they_are_called_nor_where_they_stand_in_the_table(seed):
    tracks, truth = random_tracks(seed, n_targets=6, n_frames=40)
    expected = metrics.multi_target(tracks, truth)
    rng = np.random.default_rng(seed)
    for table in (tracks, truth):
        names, places = np.unique(table[:, 1], return_inverse=True)
        table[:, 1] = rng.permutation(names * 31 - 400)[places]
        rng.shuffle(table)
        table[:, 0] += 12
        table[:, 2:4] += (40, -70)
        table[:, 6] = rng.random(len(table))
    assert metrics.multi_target(tracks, truth).as_dict() == pytest.approx(expected.as_dict())


@pytest.mark.parametrize("seed", range(5))
def test_identity_and_hota_treat_both_tables_alike(seed):
    tracks, truth = random_tracks(seed, n_targets=6, n_frames=40)
    score, swapped = metrics.multi_target(tracks, truth), metrics.multi_target(truth, tracks)
    assert (score.id_precision, score.id_recall) == pytest.approx((swapped.id_recall, swapped.id_precision))
    for name in ("idf1", "hota", "deta", "assa"):
        assert getattr(score, name) == pytest.approx(getattr(swapped, name))


# ---------------------------------------------------------------------------------------------------------------------
# Tracks: published scores
# ---------------------------------------------------------------------------------------------------------------------


NAMES = (
    ("n_targets", "mostly_tracked", "partly_tracked", "mostly_lost")
    + ("false_positives", "misses", "switches", "fragments")
    + ("idf1", "id_precision", "id_recall", "mota", "motp")
)
PUBLISHED = {
    "TUD-Campus": (8, 1, 6, 1, 13, 150, 7, 7, 55.8, 73.0, 45.1, 52.6, 72.3),
    "TUD-Stadtmitte": (10, 5, 4, 1, 45, 452, 7, 6, 64.5, 82.0, 53.1, 56.4, 65.4),
}
"""What the MOTChallenge's own program says of the tracker CEM (2015, training set); shares in percent."""


@pytest.mark.parametrize("film", PUBLISHED)
def test_published_scores(film):
    """Result, truth and score come with py-motmetrics, which is not imported: it does not run on NumPy 2."""
    folder = Path(importlib.util.find_spec("motmetrics").origin).parent / "data" / film
    score = metrics.multi_target(*(readers.read_mot(folder / name) for name in ("test.txt", "gt.txt"))).as_dict()
    for name, expected in zip(NAMES, PUBLISHED[film], strict=True):
        if isinstance(expected, float):
            assert round(100 * score[name], 1) == expected, name
        else:
            assert score[name] == expected, name
