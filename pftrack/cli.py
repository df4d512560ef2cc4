"""The ``pftrack`` command: track a target or many, score a result, fetch footage, reproduce what the book shows.

Errors are one line on standard error and exit status 2; an interrupt leaves no half-written file.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import csv
import inspect
import itertools
import json
import math
import os
import re
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pftrack import datasets, files, metrics, multi, trackers, video
from pftrack.datasets import readers, registry
from pftrack.multi import MULTI_TRACKERS, Track
from pftrack.trackers import TRACKERS, Estimate
from pftrack.trackers.base import MISSING

CSV_COLUMNS = ("frame", "x", "y", "w", "h", "score", "lost")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments : sequence of str, optional
        The words after ``pftrack``; those of the command line if not given.

    Returns
    -------
    int
        Exit status: 0 for success, 2 for an error, 130 for an interrupt.
    """
    options = _parser().parse_args(_join_box(sys.argv[1:] if arguments is None else arguments))
    try:
        with _quiet_libraries():
            options.run(options)
    except (ValueError, OSError) as error:
        print(f"pftrack: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except MemoryError:
        print("pftrack: this needs more memory than the machine has", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"pftrack: interrupted; {options.interrupted}", file=sys.stderr)
        return 130
    return 0


def _join_box(arguments: Sequence[str]) -> list[str]:
    """Join ``--box -5,20,16,30`` by a ``=``, so that a box that begins with a minus is not taken for an option."""
    words = [str(word) for word in arguments]
    for n in reversed(range(len(words) - 1)):
        if words[n] == "--box":
            words[n : n + 2] = [f"--box={words[n + 1]}"]
    return words


@contextlib.contextmanager
def _quiet_libraries() -> Iterator[None]:
    """Keep what C libraries print about damaged files (FFmpeg, libpng) off standard error, so that errors are one line.

    They write to file descriptor 2; Python's own standard error goes on through a copy of it.
    """
    if sys.stderr is None:  # closed by the caller
        yield
        return
    sys.stderr.flush()
    copy, nowhere, python_stderr = os.dup(2), os.open(os.devnull, os.O_WRONLY), sys.stderr
    if python_stderr is sys.__stderr__:
        sys.stderr = os.fdopen(copy, "w", buffering=1, encoding="utf-8", closefd=False)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        sys.stderr.flush()
        sys.stderr = python_stderr
        os.dup2(copy, 2)
        os.close(copy)
        os.close(nowhere)


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors take one line."""

    def error(self, message: str):
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="pftrack", description="Track pedestrians with particle filters.")
    parser.set_defaults(interrupted="nothing was written")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    track = commands.add_parser("track", help="follow one target through a film")
    track.add_argument("source", metavar="SOURCE", help="a dataset id, a video file, or a folder of images")
    track.add_argument("--box", metavar="X,Y,W,H", help="the target in the first frame, in pixels")
    track.add_argument("--tracker", default="color-pf", metavar="NAME", help=", ".join(TRACKERS))
    track.add_argument("--particles", type=int, metavar="N", help="number of particles (100)")
    track.add_argument("--seed", type=int, metavar="S", help="seed of the random numbers (0)")
    track.add_argument("--csv", type=Path, metavar="FILE", help=f"write {','.join(CSV_COLUMNS)}, frames from 0")
    track.add_argument("--video", type=Path, metavar="FILE", help="write an annotated MP4")
    track.set_defaults(run=_track)

    many = commands.add_parser("multi", help="follow many pedestrians through a film")
    many.add_argument("source", metavar="SOURCE", help="a dataset id, a video file, or a folder of images")
    many.add_argument("--tracker", default="association-pf", metavar="NAME", help=", ".join(MULTI_TRACKERS))
    many.add_argument("--particles", type=int, metavar="N", help="particles of each target (300)")
    many.add_argument("--seed", type=int, metavar="S", help="seed of the random numbers (0)")
    many.add_argument("--detections", type=Path, metavar="FILE", help="MOTChallenge detections, in place of our own")
    many.add_argument("--mot", type=Path, metavar="FILE", help="write MOTChallenge rows, frames from 1")
    many.add_argument("--video", type=Path, metavar="FILE", help="write an annotated MP4")
    many.set_defaults(run=_multi)

    evaluate = commands.add_parser("evaluate", help="score a result against the truth")
    result = "what pftrack track --csv or pftrack multi --mot wrote"
    truth = "a dataset id, or a file of the same form; for many targets also the XML of CAVIAR and PETS"
    evaluate.add_argument("result", type=Path, metavar="RESULT", help=result)
    evaluate.add_argument("truth", metavar="TRUTH", help=truth)
    evaluate.add_argument("--json", action="store_true", help="print JSON instead of a table")
    evaluate.set_defaults(run=_evaluate)

    data = commands.add_parser("data", help="list, fetch or locate footage")
    data.add_argument("action", nargs="?", default="list", choices=["list", "fetch", "path"])
    data.add_argument("id", nargs="?", metavar="ID", help="a dataset of the list")
    data.set_defaults(run=_data)

    reproduce = commands.add_parser("reproduce", help="recompute the tables and figures of the book at full size")
    reproduce.add_argument(
        "item",
        nargs="?",
        default="all",
        metavar="TABLE-OR-FIGURE",
        help="table2, fig3, fig6a, fig6b, sensitivity, ablation, detection, bof, comparison, "
        "association, or all of them (the default)",
    )
    reproduce.add_argument(
        "--results", type=Path, default=Path("results"), metavar="DIR", help="where to write (results)"
    )
    reproduce.add_argument("--runs", type=int, default=100, metavar="R", help="runs of each setting (100)")
    reproduce.add_argument("--jobs", type=int, metavar="J", help="worker processes (one for each core)")
    kept = "what was finished is kept, and the same command goes on from there"
    reproduce.set_defaults(run=_reproduce, interrupted=kept)
    return parser


# ---------------------------------------------------------------------------------------------------------------------
# pftrack track
# ---------------------------------------------------------------------------------------------------------------------


def _track(options: argparse.Namespace) -> None:
    tracker = _make_tracker(options)
    frames, fps, sequence = _open_source(options)
    box = _first_box(options, sequence)
    estimates: list[Estimate] = []

    def pictures() -> Iterator[np.ndarray]:
        """Annotate the frames one by one, collecting the estimates on the way."""
        ahead, behind = itertools.tee(frames)
        steps = zip(trackers.follow(tracker, ahead, box), behind, strict=False)
        for estimate, frame in tqdm(steps, total=len(frames), unit="frame", disable=None):
            estimates.append(estimate)
            yield video.annotate(frame, estimate.box, lost=estimate.lost, particles=estimate.particles)

    with contextlib.ExitStack() as outputs:  # both files appear, or neither
        film, table = (path and outputs.enter_context(files.replacing(path)) for path in (options.video, options.csv))
        if film:
            video.write(film, pictures(), fps)
        else:
            collections.deque(pictures(), maxlen=0)
        n_unread = len(frames) - len(estimates)
        estimates += [MISSING] * n_unread
        if table:
            write_csv(table, estimates)
    print(f"{len(estimates)} frames, lost in {sum(estimate.lost for estimate in estimates)}")
    if n_unread:
        print(f"the film announces {len(frames)} frames but ends {n_unread} early; those count as lost")


def _make_tracker(options: argparse.Namespace, kinds: dict[str, type] = TRACKERS):
    if options.tracker not in kinds:
        raise ValueError(f"unknown tracker {options.tracker!r}; choose one of {', '.join(kinds)}")
    kind = kinds[options.tracker]
    settings = {"n_particles": options.particles, "seed": options.seed}
    settings = {name: value for name, value in settings.items() if value is not None}
    for name in settings:
        if name not in inspect.signature(kind).parameters:
            raise ValueError(f"{options.tracker} has no {name.removeprefix('n_')}")
    return kind(**settings)


def _open_source(options: argparse.Namespace) -> tuple[datasets.Frames, float, datasets.Sequence | None]:
    """Return frames and frame rate of a dataset, a video or a folder, and the dataset if it is one."""
    if options.source in datasets.ids():
        sequence = _load(options.source)
        return sequence.frames, sequence.fps, sequence
    if not Path(options.source).exists():
        raise FileNotFoundError(
            f"there is no file, folder or dataset {options.source!r}; the datasets are {', '.join(datasets.ids())}"
        )
    frames = datasets.open_frames(options.source)
    return frames, getattr(frames, "fps", 25.0), None


def _first_box(options: argparse.Namespace, sequence: datasets.Sequence | None) -> np.ndarray:
    """Return where the target is in the first frame: what was said, or else what the dataset knows."""
    if options.box is not None:
        return parse_box(options.box)
    if sequence is None:
        raise ValueError(f"say where the target is in the first frame of {options.source} with --box X,Y,W,H")
    return sequence.boxes[0]


def _load(id: str) -> datasets.Sequence:
    """Load a dataset, with a progress bar if somebody is there to see it."""
    return datasets.load(id, progress=sys.stderr.isatty())


def parse_box(text: str) -> np.ndarray:
    """Read a box from ``X,Y,W,H``.

    Raises
    ------
    ValueError
        If the text is not four numbers.

    Examples
    --------
    >>> parse_box("10,20,30.5,40")
    array([10. , 20. , 30.5, 40. ])
    """
    try:
        x, y, w, h = (float(word) for word in text.split(","))
    except ValueError:
        raise ValueError(f"--box takes four numbers X,Y,W,H, got {text!r}") from None
    return np.array([x, y, w, h])


def write_csv(path: Path, estimates: Sequence[Estimate]) -> None:
    """Write estimates as ``frame,x,y,w,h,score,lost``; the file appears only when it is complete.

    Parameters
    ----------
    path : path
        Where to write.
    estimates : sequence of Estimate
        One for each frame; a NaN box leaves its four columns empty.
    """
    with files.replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        for frame, estimate in enumerate(estimates):
            box = ["" if math.isnan(side) else f"{side:.3f}" for side in estimate.box]
            writer.writerow([frame, *box, f"{estimate.score:.4f}", int(estimate.lost)])


def read_csv(path: Path) -> np.ndarray:
    """Read the boxes of a CSV written by :func:`write_csv`.

    Returns
    -------
    ndarray, shape (T, 4)
        Boxes ``(x, y, w, h)`` in pixels, NaN where the columns are empty or the frame is absent.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it has not the columns ``frame,x,y,w,h``.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = {int(row["frame"]): [float(row[side] or "nan") for side in "xywh"] for row in csv.DictReader(file)}
        if min(rows) < 0:
            raise ValueError("a frame has a negative number")
        boxes = np.full((max(rows) + 1, 4), np.nan)
        for frame, box in rows.items():
            boxes[frame] = box
    except (KeyError, ValueError, TypeError, IndexError, MemoryError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV with the columns {','.join(CSV_COLUMNS)}") from error
    return boxes


# ---------------------------------------------------------------------------------------------------------------------
# pftrack multi
# ---------------------------------------------------------------------------------------------------------------------


def _multi(options: argparse.Namespace) -> None:
    tracker = _make_tracker(options, MULTI_TRACKERS)
    frames, fps, _ = _open_source(options)
    detections = None if options.detections is None else readers.read_mot(options.detections)
    found: list[list[Track]] = []

    def pictures() -> Iterator[np.ndarray]:
        """Annotate the frames one by one, collecting the tracks on the way."""
        ahead, behind = itertools.tee(frames)
        steps = zip(multi.follow(tracker, ahead, detections), behind, strict=False)
        for tracks, frame in tqdm(steps, total=len(frames), unit="frame", disable=None):
            found.append(tracks)
            yield video.annotate_tracks(frame, tracks)

    with contextlib.ExitStack() as outputs:  # both files appear, or neither
        film, rows = (path and outputs.enter_context(files.replacing(path)) for path in (options.video, options.mot))
        if film:
            video.write(film, pictures(), fps)
        else:
            collections.deque(pictures(), maxlen=0)
        if rows:
            readers.write_mot(rows, multi.table(found))
    print(f"{len(found)} frames, {len({track.id for tracks in found for track in tracks})} pedestrians")
    if len(found) < len(frames):
        print(f"the film announces {len(frames)} frames but ends {len(frames) - len(found)} early")


# ---------------------------------------------------------------------------------------------------------------------
# pftrack evaluate, pftrack data
# ---------------------------------------------------------------------------------------------------------------------


def _evaluate(options: argparse.Namespace) -> None:
    score = _score_many if _is_of_many(options.result, Path(options.truth)) else _score_one
    values = score(options.result, options.truth).as_dict()
    if options.json:
        print(json.dumps({name: None if math.isnan(value) else value for name, value in values.items()}, indent=2))
        return
    for name, value in values.items():
        print(f"{name:<20}{value:>10.3f}" if isinstance(value, float) else f"{name:<20}{value:>10}")


def _is_of_many(*paths: Path) -> bool:
    """Tell rows of the MOTChallenge, seven numbers or more, from the CSV of one target, which has a header.

    The first file decides that has a line; ``pftrack multi --mot`` writes none when nobody was found.
    """
    for path in paths:
        if not path.is_file():
            continue
        with path.open(encoding="utf-8", errors="replace") as file:
            line = next((line for line in file if line.strip()), "").strip()
        if line:
            return line.startswith("<") or bool(re.match(r"([-+.\de]+\s*,\s*){6}", line))
    return True


def _score_one(result: Path, truth: str) -> metrics.SingleTargetScore:
    boxes = read_csv(result)
    expected = _load(truth).boxes if truth in datasets.ids() else read_csv(Path(truth))
    if len(boxes) != len(expected):
        raise ValueError(f"{result} has {len(boxes)} frames but {truth} has {len(expected)}")
    return metrics.single_target(boxes, expected)


def _score_many(result: Path, truth: str) -> metrics.MultiTargetScore:
    """Score tracks; of a file that is the truth, rows whose seventh number is 0 do not count, by the MOTChallenge."""
    tracks = _read_tracks(result)
    if truth not in datasets.ids():
        expected = _read_tracks(Path(truth))
        return metrics.multi_target(tracks, expected[expected[:, 6] != 0])
    sequence = _load(truth)
    if len(tracks) and tracks[-1, 0] >= len(sequence):
        raise ValueError(f"{result} goes on to frame {tracks[-1, 0] + 1:g} but {truth} has {len(sequence)}")
    return metrics.multi_target(tracks, sequence.tracks)


def _read_tracks(path: Path) -> np.ndarray:
    if path.suffix.lower() == ".xml":
        return readers.read_xml(path)
    tracks = readers.read_mot(path)
    if len(tracks) and tracks[0, 0] < 0:
        raise ValueError(f"{path} has a frame {tracks[0, 0] + 1:g}, but in MOTChallenge files frames count from 1")
    return tracks


def _data(options: argparse.Namespace) -> None:
    if options.action == "list":
        for entry in registry.ENTRIES.values():
            print(f"{entry.id:<28}{_where(entry):<16}{entry.title} [{entry.licence}]")
        for name in datasets.synthetic.SCENES:
            print(f"{name:<28}{'drawn':<16}synthetic scene with exact truth [BSD-3-Clause]")
        return
    if options.id is None:
        raise ValueError(f"pftrack data {options.action} needs the id of a dataset; pftrack data list shows them")
    if options.id in datasets.synthetic.SCENES:
        raise ValueError(f"{options.id} is drawn on demand and needs no files")
    entry = registry.entry(options.id)
    if options.action == "fetch":
        found = registry.fetch(entry.id, progress=sys.stderr.isatty())
        for path, digest in entry.checksums.items():
            registry.check_digest(found[path], digest)
        print(f"{entry.id}: {len(found)} files complete, checksums right")
        return
    found, missing = registry.locate(entry.id)
    if entry.read is None:
        raise FileNotFoundError(f"{entry.id} was never published by its authors")
    if missing:
        raise FileNotFoundError(f"{entry.id} is not on this machine; pftrack data fetch {entry.id} gets it")
    print(next(path.parents[len(Path(name).parts) - 1] for name, path in found.items()))


def _where(entry: registry.Entry) -> str:
    if entry.read is None:
        return "never published"
    if not registry.locate(entry.id)[1]:
        return "here"
    return "by hand" if entry.manual else "to download"


# ---------------------------------------------------------------------------------------------------------------------
# pftrack reproduce
# ---------------------------------------------------------------------------------------------------------------------


def _reproduce(options: argparse.Namespace) -> None:
    from pftrack import reproduce  # draws in pandas and joblib

    plan = reproduce.Plan(options.results, options.runs, options.jobs, progress=sys.stderr.isatty())
    try:
        for path in reproduce.run(options.item, plan):
            print(path, flush=True)
    except BrokenExecutor:
        raise OSError(f"a worker was ended from outside, perhaps for want of memory; {options.interrupted}") from None
