"""Which footage there is, where it comes from, and how it reaches the disk.

The files of a dataset are looked for in ``$PFTRACK_DATA/<id>``, then in the user's cache, and are otherwise downloaded
to the cache from the addresses given here (pinned to a commit where there is one). Every file's SHA-256 is recorded in
``checksums/<id>.txt``, in the format of ``sha256sum``; a download that does not match is thrown away.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from fnmatch import fnmatch
from importlib import resources
from pathlib import Path

import numpy as np
import pooch
from requests.exceptions import RequestException
from tqdm.auto import tqdm

from pftrack.datasets import readers
from pftrack.datasets.frames import ImageFrames, VideoFrames, image_paths
from pftrack.datasets.sequence import Sequence
from pftrack.files import replacing

GITHUB = "https://raw.githubusercontent.com"
DIPLOM = f"{GITHUB}/sunny-hell/diplom/4f03b46f2bb8eba8ac44e374a4b214cc729c60f7"
OPENTRAJ = f"{GITHUB}/crowdbotp/OpenTraj/97ec1d5e1b579f26febeaa9083705952deac338a/datasets/PETS-2009/data"
DCTRACKING = f"{GITHUB}/antonmil/dctracking/5db5df88ce6d7b53ea3f12ba8d79a944cf90fa49/data/TUD-Campus"
CAVIAR = "https://homepages.inf.ed.ac.uk/rbf"

BOBOT_LICENCE = "CC BY-SA 3.0 DE"
BOBOT_CITATION = "D. A. Klein, D. Schulz, S. Frintrop, A. B. Cremers: Adaptive real-time video-tracking, IROS 2010"
CAVIAR_CITATION = "EC Funded CAVIAR project/IST 2001 37540, homepages.inf.ed.ac.uk/rbf/CAVIAR"


@dataclass(frozen=True)
class Entry:
    """One dataset of the registry.

    Attributes
    ----------
    id, title : str
        Its name in the library, and what it shows.
    licence, citation : str
        On what terms it may be used, and whom to credit.
    read : callable or None
        Turns ``{relative path: file on disk}`` into a :class:`Sequence`; None if the footage was never published.
    sources : dict of str to str
        Address of the files whose relative path matches a pattern; ``{name}`` stands for the file's own name. An
        address that ends in ``.zip`` is an archive that holds them.
    manual : str
        How to get by hand what has no direct address.
    system : dict of str to str
        Places outside the data folders where a file may already be.
    """

    id: str
    title: str
    licence: str
    citation: str
    read: Callable[[Entry, dict[str, Path]], Sequence] | None = None
    sources: dict[str, str] = field(default_factory=dict)
    manual: str = ""
    system: dict[str, str] = field(default_factory=dict)

    @property
    def checksums(self) -> dict[str, str]:
        """SHA-256 of every file, by relative path; empty where none could be recorded."""
        listing = resources.files("pftrack.datasets") / "checksums" / f"{self.id}.txt"
        if not listing.is_file():
            return {}
        pairs = (line.split(maxsplit=1) for line in listing.read_text().splitlines())
        return {path: digest for digest, path in pairs}

    def address(self, path: str) -> str | None:
        """Return the address of the file with this relative path, or None if it has none."""
        url = next((url for pattern, url in self.sources.items() if fnmatch(path, pattern)), None)
        return url and url.format(name=Path(path).name)

    def sequence(self, frames, tracks, fps: float, detections=None) -> Sequence:
        """Make a sequence that carries this entry's name, title, licence and citation."""
        return Sequence(self.id, self.title, frames, tracks, fps, self.licence, self.citation, detections)


def _images(files: dict[str, Path]) -> ImageFrames:
    return ImageFrames(files[path] for path in sorted(files) if path.startswith("frames/"))


def _read_bobot_i(entry: Entry, files: dict[str, Path]) -> Sequence:
    tracks = readers.read_bobot(files["Vid_I_person_crossing.txt"], (320, 240))
    return entry.sequence(_images(files), tracks, fps=25.0)


def _read_bobot_j(entry: Entry, files: dict[str, Path]) -> Sequence:
    video = VideoFrames(files["Vid_J_person_floor.avi"])
    left, right = (
        readers.read_bobot(files[f"Vid_J{letter}_person_floor_{side}.txt"], (320, 240), target)
        for letter, side, target in (("a", "left", 1), ("b", "right", 2))
    )
    tracks = np.concatenate([left, right])
    tracks = tracks[np.lexsort((tracks[:, 1], tracks[:, 0]))]
    return entry.sequence(video[:388], tracks, fps=25.0)  # the 389th frame has no truth


def _read_pets(entry: Entry, files: dict[str, Path]) -> Sequence:
    tracks = readers.read_xml(files["PETS2009-S2L1.xml"])
    detections = readers.read_mot(files["det_frcnn.txt"])
    return entry.sequence(VideoFrames(files["vtest.avi"]), tracks, 7.0, detections)  # the file is stamped 10 fps


def _read_tud(entry: Entry, files: dict[str, Path]) -> Sequence:
    if "gt.txt" not in files:
        raise FileNotFoundError(f"{entry.id} has frames but no truth gt.txt; {entry.manual}")
    detections = readers.read_mot(files["det.txt"]) if "det.txt" in files else None
    return entry.sequence(_images(files), readers.read_mot(files["gt.txt"]), 25.0, detections)


def _read_caviar(entry: Entry, files: dict[str, Path]) -> Sequence:
    """Frames are named after their number in the clip, in the last four digits; the truth covers the whole clip."""
    frames = _images(files)
    numbers = [int(path.stem[-4:]) for path in frames.paths]
    if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        raise ValueError(f"the frames of {entry.id} are not numbered without gaps")
    truth = next((path for name, path in files.items() if name.endswith(".xml")), None)
    if truth is None:
        raise FileNotFoundError(f"{entry.id} has frames but no XML truth; {entry.manual}")
    tracks = readers.read_xml(truth)
    tracks[:, 0] -= numbers[0]
    tracks = tracks[(tracks[:, 0] >= 0) & (tracks[:, 0] < len(numbers))]
    return entry.sequence(frames, tracks, fps=25.0)


ENTRIES: dict[str, Entry] = {
    entry.id: entry
    for entry in (
        Entry(
            id="bobot-I",
            title="BoBoT sequence I, person crossing: a pedestrian followed by a moving camera",
            licence=BOBOT_LICENCE,
            citation=BOBOT_CITATION,
            read=_read_bobot_i,
            sources={
                "frames/*": f"{GITHUB}/PMMon/PedestrianTracking_PF/8cce81facf52606839230dd4b1292324fad3fd63"
                "/dataset/frames/{name}",
                "*.txt": f"{DIPLOM}/seqI/{{name}}",
            },
        ),
        Entry(
            id="bobot-J",
            title="BoBoT sequence J, person floor: two people cross and re-cross in a corridor, moving camera",
            licence=BOBOT_LICENCE,
            citation=BOBOT_CITATION,
            read=_read_bobot_j,
            sources={"*": f"{DIPLOM}/seqJ.zip"},
        ),
        Entry(
            id="pets09-s2l1",
            title="PETS 2009 S2.L1, view 1: a sparse crowd on a campus, fixed camera",
            licence="University of Reading: research use, acknowledge",
            citation="J. Ferryman, A. Shahrokni: PETS2009: dataset and challenge, PETS 2009; truth by A. Milan",
            read=_read_pets,
            sources={
                "vtest.avi": f"{GITHUB}/opencv/opencv/4.12.0/samples/data/{{name}}",
                "View_001.xml": f"{OPENTRAJ}/calibration/{{name}}",
                "*.xml": f"{OPENTRAJ}/annotations/{{name}}",
                "det_frcnn.txt": f"{GITHUB}/abewley/sort/d415d6e1f3c011f9b5ad1bfdd3c704d5c7d6d9b4"
                "/data/PETS09-S2L1/det.txt",
            },
            system={"vtest.avi": "/usr/share/doc/opencv-doc/examples/data/vtest.avi"},
        ),
        Entry(
            id="tud-campus",
            title="TUD-Campus: eight people pass each other, seen from the side",
            licence="research use",
            citation="M. Andriluka, S. Roth, B. Schiele: People-tracking-by-detection and "
            "people-detection-by-tracking, CVPR 2008",
            read=_read_tud,
            sources={
                "frames/*": f"{DCTRACKING}/img1/{{name}}",
                "gt.txt": f"{DCTRACKING}/gt/gt.txt",
                "det.txt": f"{DCTRACKING}/det/det.txt",
            },
        ),
        Entry(
            id="caviar-walk1",
            title="CAVIAR, clip Walk1, frames 236 to 511: people in a lobby, wide angle from the ceiling",
            licence="CC BY-SA, acknowledge the project",
            citation=CAVIAR_CITATION,
            read=_read_caviar,
            sources={"wk1gt.xml": f"{CAVIAR}/CAVIARDATA1/Walk1/wk1gt.xml"},
            manual=f"download the JPEG frames of clip Walk1 from {CAVIAR}/CAVIARDATA1/ and put "
            "Walk10236.jpg to Walk10511.jpg into caviar-walk1/frames/",
        ),
        Entry(
            id="caviar-corridor",
            title="CAVIAR, corridor view of a shopping centre: the kind of clip of Li et al. 2012 and 2016",
            licence="CC BY-SA, acknowledge the project",
            citation=CAVIAR_CITATION,
            read=_read_caviar,
            manual=f"download the JPEG frames and the XML truth of a corridor clip from {CAVIAR}/CAVIARDATA1/ and put "
            "them into caviar-corridor/frames/ and caviar-corridor/ (the papers do not name the clip)",
        ),
        Entry(
            id="tud-stadtmitte",
            title="TUD-Stadtmitte: a street seen from the side",
            licence="research use",
            citation="M. Andriluka, S. Roth, B. Schiele: Monocular 3D pose estimation and tracking by detection, "
            "CVPR 2010",
            read=_read_tud,
            manual="download TUD-Stadtmitte from https://motchallenge.net/data/MOT15/ and put its img1 folder and "
            "gt/gt.txt into tud-stadtmitte/frames/ and tud-stadtmitte/gt.txt",
        ),
        *(
            Entry(id=id, title=title, licence="not published", citation=citation)
            for id, title, citation in (
                ("li-2012-hall", "three pedestrians in the hall", "Li et al. 2012, sequence 1"),
                ("li-2012-square", "two pedestrians in the square", "Li et al. 2012, sequence 4"),
                ("li-2016-dynamic-background", "dynamic background, moving camera", "Li et al. 2016, sequence 1"),
            )
        ),
    )
}
"""The datasets by id."""


def entry(id: str) -> Entry:
    """Return the registry's entry for a dataset.

    Raises
    ------
    ValueError
        If the registry does not know it.
    """
    if id not in ENTRIES:
        raise ValueError(f"unknown dataset {id!r}; the registry knows {', '.join(ENTRIES)}")
    return ENTRIES[id]


def cache_folder() -> Path:
    """Folder to which datasets are downloaded."""
    return Path(pooch.os_cache("pftrack"))


def _folders() -> list[Path]:
    chosen = os.environ.get("PFTRACK_DATA")
    return [*([Path(chosen).expanduser()] if chosen else []), cache_folder()]


def locate(id: str) -> tuple[dict[str, Path], list[str]]:
    """Find the files of a dataset on this machine.

    Parameters
    ----------
    id : str
        A dataset of the registry.

    Returns
    -------
    found : dict of str to Path
        The files that are here, by their relative path.
    missing : list of str
        The relative paths that are not.

    Raises
    ------
    ValueError
        If the registry does not know the dataset.
    """
    known = entry(id)
    if not known.checksums:  # no list was recorded: take what the folder holds
        for folder in _folders():
            place = folder / id
            images = {f"frames/{path.name}": path for path in image_paths(place / "frames")}
            truth = {path.name: path for path in (*place.glob("*.xml"), *place.glob("*.txt"))}
            if images and truth:
                return images | truth, []
        return {}, [f"frames/ and the truth of {id}"]
    found, missing = {}, []
    for path in known.checksums:
        places = [folder / id / path for folder in _folders()]
        places += [Path(known.system[path])] if path in known.system else []
        place = next((place for place in places if place.is_file()), None)
        if place is None:
            missing.append(path)
        else:
            found[path] = place
    return found, missing


def fetch(id: str, progress: bool = True) -> dict[str, Path]:
    """Return the files of a dataset, downloading to the cache those that are not here.

    Parameters
    ----------
    id : str
        A dataset of the registry.
    progress : bool
        Whether to show a progress bar while downloading.

    Returns
    -------
    dict of str to Path
        The files by relative path. What was complete before an interruption is not downloaded again.

    Raises
    ------
    ValueError
        If the registry does not know the dataset, or a downloaded file does not have the recorded SHA-256.
    FileNotFoundError
        If the files are not here and cannot be downloaded.
    """
    known = entry(id)
    if known.read is None:
        raise FileNotFoundError(f"{id} ({known.title}, {known.citation}) was never published by its authors")
    found, missing = locate(id)
    if not missing:
        return found
    folder = cache_folder() / id
    for path in tqdm(missing, desc=id, unit="file", disable=not progress):
        if path in found:
            continue  # it came out of an archive
        address = known.address(path)
        if address is None:
            raise FileNotFoundError(
                f"{id} is not complete: {path} is not in $PFTRACK_DATA/{id} or {folder}, and cannot be downloaded "
                f"automatically; {known.manual}, below the folder that PFTRACK_DATA names"
            )
        try:
            if address.endswith(".zip"):
                inside = {name: known.checksums[name] for name in missing if known.address(name) == address}
                found |= _retrieve_archive(address, folder, inside)
            else:
                target = folder / path
                found[path] = _retrieve(address, target.parent, target.name, known.checksums[path])
        except RequestException as error:
            raise FileNotFoundError(
                f"{id} is not complete: {path} is not in $PFTRACK_DATA/{id} or {folder}, and downloading it from "
                f"{address} failed ({type(error).__name__}); if you have the files elsewhere, set PFTRACK_DATA to the "
                f"folder that holds {id}/"
            ) from None  # the chain of network errors would bury the message
    return found


def _retrieve(address: str, folder: Path, name: str, digest: str | None) -> Path:
    """Download one file; it appears at its place only when it is complete and its SHA-256 is right."""
    pooch.get_logger().setLevel("ERROR")
    downloader = pooch.HTTPDownloader(timeout=30)
    try:
        return Path(pooch.retrieve(address, digest, fname=name, path=folder, downloader=downloader))
    except ValueError:  # pooch has deleted it
        raise ValueError(
            f"{name} from {address} has the wrong SHA-256: the download was incomplete or the file was changed there; "
            "try again"
        ) from None


def _retrieve_archive(address: str, folder: Path, digests: dict[str, str]) -> dict[str, Path]:
    """Download an archive and take the listed files out of it, wherever in it they lie."""
    with tempfile.TemporaryDirectory() as scratch:
        archive_path = _retrieve(address, Path(scratch), "archive.zip", None)
        try:
            with zipfile.ZipFile(archive_path) as archive:
                members = {Path(name).name: name for name in archive.namelist()}
                for path, digest in digests.items():
                    (folder / path).parent.mkdir(parents=True, exist_ok=True)
                    with replacing(folder / path) as file:
                        file.write_bytes(archive.read(members[Path(path).name]))
                        check_digest(file, digest, name=f"{path} in {address}")
        except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, KeyError) as error:
            raise ValueError(f"{address} is damaged or not the expected archive ({error}); try again") from error
    return {path: folder / path for path in digests}


def check_digest(path: Path, digest: str, name: str | None = None) -> None:
    """Compare a file's SHA-256 with the recorded one.

    Raises
    ------
    ValueError
        If they differ.
    """
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != digest:
        raise ValueError(
            f"{name or path} has the wrong SHA-256 ({found[:12]}… instead of {digest[:12]}…): it is incomplete or was "
            "changed; delete it and fetch it again"
        )
