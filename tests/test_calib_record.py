"""The record of a calibration: whole, or refused; never taken for one that tells of no doubt."""

import copy
import inspect
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from helpers.boards import look_at, make_camera
from helpers.records import make_camera_record, make_check, make_opinion, make_record

from hybridve.calib import record as record_module
from hybridve.calib import verdict as verdict_module
from hybridve.calib.errors import CalibrationError
from hybridve.calib.formats.rig_json import read_rig, rig_to_dict, write_rig
from hybridve.calib.plain import Told, to_plain
from hybridve.calib.provenance import MadeElsewhere, provenance_from_plain
from hybridve.calib.record import (
    BY_SCENE,
    Adjustment,
    CalibrationRecord,
    CandidateLens,
    ClocksRecord,
    Labelling,
    LensChoice,
    MountRecord,
    Noise,
    NoOpinion,
    Outlier,
    WorldRecord,
)
from hybridve.calib.rig import Rig
from hybridve.calib.verdict import Moved, RigTest, Turned

Run = Callable[..., int]
Captured = pytest.CaptureFixture[str]

#: Fields that a file may lack, as they say nothing that a gate asks for, or an older program left
#: them out. Every other field of every dataclass of a record must be there.
MAY_BE_MISSING = {
    "Adjustment.start",
    "CalibrationRecord.clocks",
    "CalibrationRecord.noise_by_group",
    "CameraRecord.model_chosen",
    "CameraRecord.mount",
    "ClipRecord.other_tilt_times_worse",
    "ClipRecord.spread_over_clip_px",
    "ClocksRecord.advice",
    "ClocksRecord.views_left_out",
    "WorldRecord.board",
    "WorldRecord.cameras",
    "WorldRecord.instant",
    "WorldRecord.misses_px",
    "WorldRecord.residuals_mm",
    "WorldRecord.scale",
}

WEAK = Labelling(
    looks=2,
    decided_by=f"{BY_SCENE} and corners by hand",
    matches_by_look={"still moving": (3, 4)},
    margin_sigma={"still": 1.25},
    weakest_sigma=1.25,
    is_weak=True,
)
CONTRADICTION = "camera 'still' does not agree with the others"


def whole() -> CalibrationRecord:
    """A record that tells all that a record can tell, with every doubt there is."""
    still = make_camera_record()
    still = replace(
        still,
        extrinsics=replace(
            still.extrinsics, corners_by_hand="corners.xml", spread_over_clip_px=0.02
        ),
        model_chosen=LensChoice(
            "PINHOLE", "it fits", 0.2, 1.5, 40.0, {"PINHOLE": CandidateLens(0.0, 0.2, 4, 0.0)}
        ),
    )
    mount = MountRecord(
        instants=3,
        middle_instant=1,
        views=3,
        looks_turned=0,
        untracked=(7,),
        dropped={"9.png": "the board cannot be located"},
        rms_px=0.2,
        closed_form_rms_px=0.3,
        turn_deg=(30.0, 20.0, 10.0),
        tracker_scale=1.0,
        tracker_scale_std=0.01,
        parameters=("rx",),
        covariance=((1.0,),),
        covariance_from="corners",
        offset_std_mm=1.0,
        offset_std_deg=0.1,
        pose_covariance=((1.0,),),
    )
    return make_record(
        (),
        cameras={"still": still, "moving": replace(make_camera_record(0.3, None), mount=mount)},
        clocks=ClocksRecord(
            reference="still",
            offset_frames={"still": 0.0, "moving": None},
            std_frames={"still": 0.0, "moving": None},
            notes=("moving saw too little",),
            views_left_out={"still": (4,)},
            advice="say offset_s",
        ),
        labelling=WEAK,
        noise_by_group={"board clip": Noise(0.2, 0.2, 0.3, 1.0, 100, 10)},
        world=WorldRecord(
            kind="points",
            text="4 named points",
            board="a board",
            instant=3,
            cameras=("still",),
            residuals_mm={"p": 0.1},
            scale=1.0,
            misses_px={"p": {"still": 0.1}},
            warnings=("look at p",),
        ),
        settings={"lens": {"loss_px": 1.0}},
        adjustment=Adjustment(
            steps=3,
            views=9,
            outliers=1,
            worst_outliers=(Outlier("still", "3.png", 0, 17, 2.5),),
            left_out={"4.png": "it contradicts the others"},
            warnings=(CONTRADICTION,),
            start="COLMAP's adjustment",
        ),
        second_opinion=make_opinion(9.0),
    )


def whole_test() -> RigTest:
    check = make_check(
        scale=1.02,
        pair_scales={"still moving": 1.02},
        rms_px={"still": 0.5},
        odd_camera="still",
        moved={"still": Moved("pose", 3.0, 0.1, 1.0, 4.0, 0.5)},
        suspects=("still",),
        exchanged=("still", "moving"),
        turned={"still": Turned(180.0, 0.5, 3.0)},
        turned_sides=(("still",),),
        undecided=("still",),
        twins=(("still", "moving"),),
        untested=("moving",),
        p_value=0.5,
        scale_sigma=0.01,
    )
    return RigTest("open", check.message, check)


Place = tuple[str | int, ...]


def places_of(value: object, at: Place = ()) -> Iterator[tuple[str, Place]]:
    """Yield "Class.field", and the keys that lead to it in JSON, for all fields that tell."""
    if is_dataclass(value):
        for one in fields(value):
            if getattr(value, one.name) is not None:
                here = (*at, one.name.removesuffix("_"))
                yield f"{type(value).__name__}.{one.name}", here
                yield from places_of(getattr(value, one.name), here)
    elif isinstance(value, Mapping):
        for key, entry in value.items():
            yield from places_of(entry, (*at, key))
    elif isinstance(value, tuple):
        for index, entry in enumerate(value):
            yield from places_of(entry, (*at, index))


#: Each field at the first place where it stands.
PLACES = dict(reversed(list(places_of(whole()))))
CHECK_PLACES = dict(reversed(list(places_of(whole_test().check, ("check",)))))


def changed(plain: dict[str, Any], place: Place, how: str) -> dict[str, Any]:
    """Return a copy in which what stands at a place is missing, renamed or something else."""
    spoilt = copy.deepcopy(plain)
    owner: Any = spoilt
    for key in place[:-1]:
        owner = owner[key]
    value = owner.pop(place[-1])
    if how == "renamed":
        owner[f"{place[-1]}s"] = value
    elif how == "of another type":
        owner[place[-1]] = [None]
    return spoilt


def content_of(rig: Rig) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(json.dumps(rig_to_dict(rig)))
    return content


def spoilt_file(folder: Path, rig: Rig, place: Place, how: str) -> Path:
    content = content_of(rig)
    content["provenance"] = changed(content["provenance"], place, how)
    path = folder / "rig.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


@pytest.fixture
def rig() -> Rig:
    cameras = [
        make_camera(name, "PINHOLE", look_at((x, -1.0, 1.0), (0.0, 0.0, 0.0)))
        for name, x in (("still", 0.0), ("moving", 1.0))
    ]
    return Rig(tuple(cameras), whole(), check=whole_test())


def test_every_field_of_a_record_and_of_a_check_is_tried() -> None:
    """A field that is added must be given a value above, and so is tried below."""
    kinds: set[Any] = {
        kind
        for module in (record_module, verdict_module)
        for kind in vars(module).values()
        if inspect.isclass(kind) and issubclass(kind, Told) and kind not in (Told, RigTest)
    }
    known = {f"{kind.__name__}.{one.name}" for kind in kinds for one in fields(kind)}

    assert known == PLACES.keys() | CHECK_PLACES.keys() | {"NoOpinion.reason"}


def test_a_record_and_a_check_are_read_back_as_they_were(tmp_path: Path, rig: Rig) -> None:
    write_rig(tmp_path / "rig.json", rig)
    again = read_rig(tmp_path / "rig.json")
    write_rig(tmp_path / "again.json", again)

    assert again.provenance == rig.provenance
    assert again.check == rig.check
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "rig.json").read_bytes()


def test_a_record_without_a_second_opinion_says_why_or_is_older() -> None:
    plain = to_plain(replace(whole(), second_opinion=NoOpinion("COLMAP rests")))
    told = provenance_from_plain(plain)
    assert isinstance(told, CalibrationRecord)
    assert told.second_opinion == NoOpinion("COLMAP rests")
    assert told.doubts == whole().doubts[:-1]
    for spoilt in (
        changed(plain, ("second_opinion", "reason"), "missing"),
        changed(plain, ("second_opinion", "reason"), "of another type"),
        changed(plain, ("second_opinion",), "missing"),
    ):
        with pytest.raises(CalibrationError, match=r"provenance.*second_opinion"):
            provenance_from_plain(spoilt)

    older = changed(
        changed(plain, ("second_opinion",), "missing"), ("adjustment", "start"), "missing"
    )

    told = provenance_from_plain(older)
    assert isinstance(told, CalibrationRecord)
    assert told.second_opinion is None


@pytest.mark.parametrize("how", ["missing", "renamed", "of another type"])
@pytest.mark.parametrize("name", PLACES)
def test_a_record_that_is_not_whole_is_refused(
    tmp_path: Path, rig: Rig, name: str, how: str
) -> None:
    path = spoilt_file(tmp_path, rig, PLACES[name], how)

    if how == "missing" and name in MAY_BE_MISSING:
        told = read_rig(path).provenance
        assert isinstance(told, CalibrationRecord)
        assert (told.doubts, told.warnings) == (whole().doubts, whole().warnings)
    else:
        with pytest.raises(CalibrationError, match=rf"^{path}: provenance.*{PLACES[name][-1]}"):
            read_rig(path)


@pytest.mark.parametrize("how", ["missing", "renamed", "of another type"])
def test_a_record_that_is_not_whole_is_one_line_and_a_status(
    run: Run, capsys: Captured, tmp_path: Path, rig: Rig, how: str
) -> None:
    path = spoilt_file(tmp_path, rig, ("adjustment", "warnings"), how)

    assert run("convert", path, "--to", "csv", "-o", tmp_path / "rig.csv") == 1

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {path}: provenance.adjustment.warnings")


@pytest.mark.parametrize("how", ["missing", "renamed", "of another type"])
@pytest.mark.parametrize("name", [*CHECK_PLACES, "verdict"])
def test_a_check_that_is_not_whole_is_refused_or_none(
    tmp_path: Path, rig: Rig, name: str, how: str
) -> None:
    """An earlier program told less of a check: nothing is known then, which is not agreement."""
    place = CHECK_PLACES.get(name, ("check", name))
    path = spoilt_file(tmp_path, rig, place, how)
    infinite = {"scale", "p_value", "scale_sigma"}

    if how == "missing" and len(place) == 2 and place[1] not in infinite:
        assert read_rig(path).check is None
    elif how == "missing" and len(place) == 2:
        check = read_rig(path).check
        assert check is not None
        assert check.to_dict().keys() == rig.check.to_dict().keys() - {place[1]}  # type: ignore[union-attr]
    else:
        with pytest.raises(CalibrationError, match=rf"^{path}: check.*{place[-1]}"):
            read_rig(path)


def test_a_check_that_tested_nothing_is_read_back(tmp_path: Path, rig: Rig) -> None:
    untested = replace(rig, check=RigTest("no board", "there is none"))
    write_rig(tmp_path / "rig.json", untested)

    assert read_rig(tmp_path / "rig.json").check == untested.check


@pytest.mark.parametrize("how", ["missing", "renamed", "of another type"])
def test_boards_that_lay_still_were_labelled(rig: Rig, how: str) -> None:
    """Nothing was to be decided of this board; that it was not is told all the same."""
    plain = to_plain(make_record(["still"]))

    assert provenance_from_plain(plain) == make_record(["still"])
    with pytest.raises(CalibrationError, match="labelling"):
        provenance_from_plain(changed(plain, ("labelling",), how))


@pytest.mark.parametrize(
    "told",
    [
        None,
        {},
        {"method": "imported", "file": "rig.csv", "format": "csv"},
        {"note": "by hand", "labelling": "none", "adjustment": {"warnings": []}},
    ],
)
def test_a_rig_made_elsewhere_tells_nothing_of_doubts(
    tmp_path: Path, rig: Rig, told: dict[str, Any] | None
) -> None:
    content = content_of(rig)
    content["provenance"] = told
    if told is None:
        del content["provenance"]
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(content), encoding="utf-8")

    found = read_rig(path)

    assert found.provenance == MadeElsewhere(told or {})
    assert not hasattr(found.provenance, "doubts")
    assert content_of(found)["provenance"] == (told or {})


@pytest.mark.parametrize("mark", ["method", "software"])
def test_a_record_is_known_by_either_of_two_marks(mark: str) -> None:
    """A record that lost one of them is not taken for a rig made elsewhere."""
    plain = to_plain(make_record(["still"]))
    del plain[mark]

    with pytest.raises(CalibrationError, match=f"provenance.{mark}: is missing"):
        provenance_from_plain(plain)


def test_each_doubt_is_told_once_and_alone() -> None:
    sure = make_record(["still"])
    assert sure.adjustment is not None
    weak = replace(sure, labelling=WEAK)
    contradicted = replace(sure, adjustment=replace(sure.adjustment, warnings=(CONTRADICTION,)))

    assert sure.doubts == ()
    assert contradicted.doubts == (CONTRADICTION,)
    (doubt,) = weak.doubts
    assert "which way round" in doubt
    (other,) = replace(sure, second_opinion=make_opinion(9.0)).doubts
    assert other.startswith("COLMAP's own adjustment")
    assert "9.00 mm" in other
    assert "9.0 standard" in other
    assert whole().doubts == (CONTRADICTION, doubt, other)
    assert whole().warnings == ("look at p",)


@pytest.mark.parametrize(
    "change",
    [
        {"sigmas": 3.9},  # it may be chance
        {"difference95_m": 2.9e-3},  # it is within what is stated
        {"difference95_px": 0.009},  # it is rounding
    ],
)
def test_a_difference_is_a_doubt_only_where_all_speaks_for_it(change: dict[str, float]) -> None:
    clear = make_opinion(9.0)

    assert clear.disagrees
    assert not replace(clear, **change).disagrees


def test_cameras_that_are_called_anew_keep_what_is_told_of_them() -> None:
    told = whole()

    renamed = told.renamed({"still": "left"})

    assert renamed.cameras == {"left": told.cameras["still"], "moving": told.cameras["moving"]}
