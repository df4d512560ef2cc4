"""Ground-truth files: each format, what is wrong with a bad file, and one real file of each."""

import re

import numpy as np
import pytest

from pftrack.datasets import readers, registry

XML = """<?xml version="1.0" encoding="utf-8"?>
<dataset>
  <frame number="1">
    <objectlist>
      <object id="7"><box h="40" w="20" xc="110" yc="60.5"/></object>
      <object id="2">
        <orientation>90</orientation><box h="10.5" w="5" xc="30" yc="50"/><appearance>visible</appearance>
      </object>
    </objectlist>
    <grouplist>
      <group id="0"><box h="100" w="100" xc="50" yc="50"/><members>7,2</members></group>
    </grouplist>
  </frame>
  <frame number="0">
    <objectlist><object id="7"><box h="40" w="20" xc="100" yc="60"/></object></objectlist>
    <grouplist></grouplist>
  </frame>
</dataset>
"""


def save(tmp_path, text, name="truth.txt"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


# ---------------------------------------------------------------------------------------------------------------------
# Small files of each format
# ---------------------------------------------------------------------------------------------------------------------


def test_bobot_scales_shares_to_pixels_and_hides_boxes_of_zeros(tmp_path):
    path = save(tmp_path, "film.avi\n0 0.25 0.5 0.1 0.2\n1 0 0 0 0\n\n2 0.5 0.25 0.125 0.5\n")
    tracks = readers.read_bobot(path, image_size=(320, 240), target=3)
    expected = [[0, 3, 80, 120, 32, 48, 1], [2, 3, 160, 60, 40, 120, 1]]
    np.testing.assert_allclose(tracks, expected, rtol=1e-12)
    boxes = readers.boxes_of(tracks, 3, n_frames=4)
    assert np.isnan(boxes[[1, 3]]).all()
    np.testing.assert_allclose(boxes[[0, 2]], [row[2:6] for row in expected])


def test_mot_frames_begin_at_0_and_further_columns_are_ignored(tmp_path):
    path = save(tmp_path, "2,5,10,20,30,40,0.5,-1,-1,-1\n1,6,1.5,2.5,3.5,4.5,1\n1, -1, 11, 12, 13, 14, 0.25, x\n")
    np.testing.assert_array_equal(
        readers.read_mot(path),
        [[0, -1, 11, 12, 13, 14, 0.25], [0, 6, 1.5, 2.5, 3.5, 4.5, 1], [1, 5, 10, 20, 30, 40, 0.5]],
    )


def test_xml_centres_become_corners_and_groups_are_left_out(tmp_path):
    np.testing.assert_array_equal(
        readers.read_xml(save(tmp_path, XML)),
        [[0, 7, 90, 40, 20, 40, 1], [1, 2, 27.5, 44.75, 5, 10.5, 1], [1, 7, 100, 40.5, 20, 40, 1]],
    )


def test_write_mot_then_read_mot_gives_the_table_back(tmp_path):
    rng = np.random.default_rng(0)
    n_rows = 200
    tracks = np.column_stack(
        [
            np.repeat(np.arange(50), 4),
            np.tile([1, 2, 5, 123456], 50),
            rng.uniform(-100, 2000, (n_rows, 4)),
            rng.random(n_rows),
        ]
    )
    path = tmp_path / "tracks.txt"
    readers.write_mot(path, tracks)
    again = readers.read_mot(path)
    np.testing.assert_array_equal(again[:, :2], tracks[:, :2])
    np.testing.assert_allclose(again[:, 2:6], tracks[:, 2:6], atol=0.01)
    np.testing.assert_allclose(again[:, 6], tracks[:, 6], atol=1e-4)


def test_write_mot_writes_the_columns_of_the_challenge_with_frames_from_1(tmp_path):
    readers.write_mot(tmp_path / "tracks.txt", [[0, 3, 10.5, 20, 30, 40, 1], [7, -1, 1, 2, 3, 4, 0.75]])
    assert (tmp_path / "tracks.txt").read_text() == "1,3,10.5,20,30,40,1,-1,-1,-1\n8,-1,1,2,3,4,0.75,-1,-1,-1\n"


def test_an_empty_table_can_be_written_and_read(tmp_path):
    readers.write_mot(tmp_path / "tracks.txt", np.empty((0, 7)))
    assert readers.read_mot(tmp_path / "tracks.txt").shape == (0, 7)


def test_write_mot_into_a_folder_that_does_not_exist_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"folder .*nowhere does not exist"):
        readers.write_mot(tmp_path / "nowhere" / "tracks.txt", np.empty((0, 7)))


def test_a_broken_table_leaves_no_file_and_keeps_the_old_one(tmp_path):
    path = save(tmp_path, "old", "tracks.txt")
    with pytest.raises(ValueError):
        readers.write_mot(path, [[0, 1, 2, 3, 4, 5]])
    assert [file.name for file in tmp_path.iterdir()] == ["tracks.txt"]
    assert path.read_text() == "old"


# ---------------------------------------------------------------------------------------------------------------------
# Bad files
# ---------------------------------------------------------------------------------------------------------------------


def read_bobot(path):
    return readers.read_bobot(path, (320, 240))


@pytest.mark.parametrize(
    ("read", "text", "place", "hint"),
    [
        (read_bobot, "film.avi\n0 0.1 0.1 0.1 0.1\n1 0.1 0.1 0.1\n", "line 3", "frame x y w h"),
        (read_bobot, "film.avi\n0 0.1 0.1 0.1 0.1 0.1\n", "line 2", "frame x y w h"),
        (read_bobot, "film.avi\n0 0.1 zero 0.1 0.1\n", "line 2", "frame x y w h"),
        (read_bobot, "film.avi\n\n\n0,0.1,0.1,0.1,0.1\n", "line 4", "frame x y w h"),
        (readers.read_mot, "1,1,10,20,30,40,1\n2,1,10,20,30,40\n", "line 2", "frame,id,x,y,w,h,score"),
        (readers.read_mot, "frame,id,x,y,w,h,score\n", "line 1", "frame,id,x,y,w,h,score"),
        (readers.read_mot, "1,1,10,20,30,40,1\n\n2 1 10 20 30 40 1\n", "line 3", "frame,id,x,y,w,h,score"),
        (readers.read_xml, XML.replace("</frame>", "", 1), "line [0-9]+", "not a CAVIAR or PETS"),
        (readers.read_xml, "", "line 1", "not a CAVIAR or PETS"),
        (readers.read_xml, "frame 1 box 2\n", "line 1", "not a CAVIAR or PETS"),
        (readers.read_xml, XML.replace('xc="30"', ""), "xc", "not a CAVIAR or PETS"),
        (readers.read_xml, XML.replace('w="5"', 'w="wide"'), "wide", "not a CAVIAR or PETS"),
        (readers.read_xml, XML.replace('id="2"', ""), "id", "not a CAVIAR or PETS"),
        (readers.read_xml, XML.replace('number="0"', ""), "number", "not a CAVIAR or PETS"),
        (readers.read_xml, XML.replace('<box h="40" w="20" xc="100" yc="60"/>', ""), "", "not a CAVIAR or PETS"),
    ],
)
def test_a_malformed_file_is_a_value_error_naming_file_and_place(tmp_path, read, text, place, hint):
    with pytest.raises(ValueError, match=r"truth\.txt") as error:
        read(save(tmp_path, text))
    assert re.search(place, str(error.value))
    assert hint in str(error.value)


@pytest.mark.parametrize(
    ("good", "bad", "frame"),
    [
        ('xc="30"', "", 1),
        ('w="5"', 'w="wide"', 1),
        ('id="2"', "", 1),
        ('<box h="40" w="20" xc="100" yc="60"/>', "", 0),
    ],
)
def test_a_bad_object_in_xml_is_found_by_its_frame_or_line(tmp_path, good, bad, frame):
    """A truth file has thousands of boxes; the message must lead to the bad one."""
    with pytest.raises(ValueError, match=rf"frame (number=)?\W?{frame}\b|line \d+"):
        readers.read_xml(save(tmp_path, XML.replace(good, bad)))


def test_xml_of_another_kind_is_not_taken_for_an_empty_truth(tmp_path):
    with pytest.raises(ValueError, match=r"page\.xml is not a CAVIAR or PETS"):
        readers.read_xml(save(tmp_path, "<html><body><p>404: not found</p></body></html>", "page.xml"))


@pytest.mark.parametrize("read", [read_bobot, readers.read_mot, readers.read_xml])
def test_a_missing_file_is_named(tmp_path, read):
    with pytest.raises(FileNotFoundError, match=r"no file .*truth\.txt"):
        read(tmp_path / "truth.txt")


@pytest.mark.parametrize("read", [read_bobot, readers.read_mot, readers.read_xml])
def test_a_binary_file_is_named(tmp_path, read):
    (tmp_path / "truth.txt").write_bytes(b"\xff\xd8\xff\xe0 a picture")
    with pytest.raises(ValueError, match=r"truth\.txt is not a text file"):
        read(tmp_path / "truth.txt")


# ---------------------------------------------------------------------------------------------------------------------
# Boxes of one target
# ---------------------------------------------------------------------------------------------------------------------


def test_boxes_of_takes_one_target_and_ignores_rows_beyond_the_film():
    tracks = [[0, 1, 1, 2, 3, 4, 1], [0, 2, 9, 9, 9, 9, 1], [2, 1, 5, 6, 7, 8, 1], [3, 1, 0, 0, 1, 1, 1]]
    np.testing.assert_array_equal(
        readers.boxes_of(tracks, target=1, n_frames=3), [[1, 2, 3, 4], [np.nan] * 4, [5, 6, 7, 8]]
    )


def test_an_unknown_target_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match=r"no target 3; the ids are \[1, 2\]"):
        readers.boxes_of([[0, 2, 9, 9, 9, 9, 1], [0, 1, 1, 2, 3, 4, 1]], target=3, n_frames=1)


# ---------------------------------------------------------------------------------------------------------------------
# One real file of each format, with counts taken from the files by other means
# ---------------------------------------------------------------------------------------------------------------------


def text_of(id, path):
    return registry.locate(id)[0][path].read_text()


def check_frames_and_tracks(sequence, n_frames, shape):
    """Facts that hold for every sequence: lengths, picture sizes, frames from 0, boxes in the picture."""
    assert len(sequence) == len(sequence.frames) == n_frames
    assert sequence.frames[0].shape == sequence.frames[-1].shape == shape
    assert sequence.boxes.shape == (n_frames, 4)
    assert sequence.tracks[:, 0].min() >= 0
    assert sequence.tracks[:, 0].max() == n_frames - 1
    assert (sequence.tracks[:, 4:6] > 0).all()
    centers = sequence.tracks[:, 2:4] + sequence.tracks[:, 4:6] / 2
    assert ((centers > -50) & (centers < [shape[1] + 50, shape[0] + 50])).all()
    assert sequence.licence
    assert sequence.citation


def test_bobot_i_has_1017_frames_and_is_hidden_in_23(footage):
    sequence = footage("bobot-I")
    check_frames_and_tracks(sequence, 1017, (240, 320, 3))
    words = [line.split() for line in text_of("bobot-I", "Vid_I_person_crossing.txt").splitlines()[1:] if line.strip()]
    hidden = [int(line[0]) for line in words if float(line[3]) == 0]
    assert len(words) == 1017
    assert len(hidden) == 23
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(sequence.boxes[:, 0])), hidden)
    first = np.array(words[0][1:], dtype=float) * [320, 240, 320, 240]
    np.testing.assert_allclose(sequence.boxes[0], first)
    assert sequence.fps == 25


def test_bobot_j_has_388_frames_and_two_people(footage):
    sequence = footage("bobot-J")
    check_frames_and_tracks(sequence, 388, (240, 320, 3))
    assert sequence.ids == [1, 2]
    for target, name in ((1, "Vid_Ja_person_floor_left.txt"), (2, "Vid_Jb_person_floor_right.txt")):
        lines = [line.split() for line in text_of("bobot-J", name).splitlines()[1:] if line.strip()]
        n_visible = sum(float(line[3]) > 0 for line in lines)
        assert np.isfinite(sequence.target(target)).all(axis=1).sum() == n_visible
    left, right = sequence.target(1), sequence.target(2)
    assert left[0, 0] < right[0, 0]


def test_pets_has_795_frames_4650_boxes_and_19_ids(footage):
    sequence = footage("pets09-s2l1")
    check_frames_and_tracks(sequence, 795, (576, 768, 3))
    assert len(sequence.tracks) == 4650
    assert len(sequence.ids) == len(set(sequence.ids)) == 19
    text = text_of("pets09-s2l1", "PETS2009-S2L1.xml")
    assert len(re.findall(r"<object\b", text)) == 4650
    number = re.search(r'<frame number="(\d+)">', text)[1]
    box = dict(re.findall(r'(\w+)="([-\d.]+)"', re.search(r"<box[^>]*>", text)[0]))
    x, y = float(box["xc"]) - float(box["w"]) / 2, float(box["yc"]) - float(box["h"]) / 2
    row = [x, y, float(box["w"]), float(box["h"])]
    in_frame = sequence.tracks[sequence.tracks[:, 0] == float(number)][:, 2:6]
    assert np.isclose(in_frame, row).all(axis=1).any()
    assert len(sequence.detections) == len(text_of("pets09-s2l1", "det_frcnn.txt").split())
    assert (sequence.detections[:, 1] == -1).all()
    assert sequence.fps == 7


def test_tud_campus_has_71_frames_359_boxes_8_ids_and_344_detections(footage):
    sequence = footage("tud-campus")
    check_frames_and_tracks(sequence, 71, (480, 640, 3))
    assert len(sequence.tracks) == len(text_of("tud-campus", "gt.txt").split()) == 359
    assert len(sequence.detections) == len(text_of("tud-campus", "det.txt").split()) == 344
    assert len(sequence.ids) == 8
    assert sequence.tracks[0, 0] == sequence.detections[:, 0].min() == 0


def test_caviar_has_276_frames_that_begin_at_frame_236_of_the_clip(footage):
    sequence = footage("caviar-walk1")
    check_frames_and_tracks(sequence, 276, (288, 384, 3))
    text = text_of("caviar-walk1", "wk1gt.xml")
    objects = {}
    for number, content in re.findall(r'<frame number="(\d+)">(.*?)</frame>', text, flags=re.DOTALL):
        objects[int(number)] = len(re.findall(r"<object\b", content))
    n_boxes = np.bincount(sequence.tracks[:, 0].astype(int), minlength=276)
    assert n_boxes.tolist() == [objects[number] for number in range(236, 512)]


def test_a_real_table_survives_write_mot(footage, tmp_path):
    tracks = footage("tud-campus").tracks
    readers.write_mot(tmp_path / "tracks.txt", tracks)
    np.testing.assert_allclose(readers.read_mot(tmp_path / "tracks.txt"), tracks, atol=0.005)
