"""``hybridve synth``: presets, their options, and what is refused."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.session import load_session
from hybridve.hull.synth import PRESETS, read_truth

Run = Callable[..., int]


@pytest.fixture(scope="module")
def synth(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Generate a recording with few pictures of the board; returns its folder."""
    from click.testing import CliRunner

    from hybridve.cli.main import cli
    from hybridve.hull.synth import write

    def generate(preset: str, *options: object) -> Path:
        folder = tmp_path_factory.mktemp("synth") / preset
        with pytest.MonkeyPatch.context() as patch:
            for name in ("N_STILLS", "N_BOARD_FRAMES", "N_BACKGROUND_FRAMES"):
                patch.setattr(write, name, 1)
            asked = ["synth", preset, "-o", folder, *options]
            result = CliRunner().invoke(cli, list(map(str, asked)), catch_exceptions=False)
        assert result.exit_code == 0
        assert result.stdout.strip() == str(folder / "session.toml")
        return folder

    return generate


@pytest.fixture(scope="module")
def folder(synth: Callable[..., Path]) -> Path:
    return synth("payload", "--participant", 2, "--gap-mm", 180, "--n-frames", 4)


def test_the_help_names_every_preset(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("synth", "--help") == 0

    lines = [line.split() for line in capsys.readouterr().out.splitlines()]

    for name in PRESETS:
        assert [words[0] for words in lines if words].count(name) == 1


@pytest.mark.slow
def test_what_was_chosen_stands_in_the_files(folder: Path) -> None:
    truth = read_truth(folder)
    scene = load_scene(folder / "scene.toml")
    places = {thing.name: thing.box_world for thing in scene.objects}

    assert truth.options == {"participant": 2, "gap_mm": 180.0}
    assert "payload, participant 2, gap_mm 180" in (folder / "session.toml").read_text()
    assert list(places) == ["pmt", "payload_a", "payload_b"]
    assert places["payload_a"][0][2] - places["pmt"][1][2] == pytest.approx(0.18, abs=1e-6)
    required = {thing.name: thing.required_clearance_m for thing in scene.objects}
    assert required == pytest.approx({"pmt": 0.002, "payload_a": 0.005, "payload_b": 0.01})


@pytest.mark.slow
def test_the_spacing_reads_back_as_it_was_asked(folder: Path) -> None:
    found = read_truth(folder).spacing["payload_a"]

    assert found.along.tolist() == [0.0, 0.0, 1.0]
    assert found.gap_cm == 18.0
    assert found.required_clearance_m == 0.005
    for needed_m, gap_cm, by_frame_m, frame in (
        (found.needed_m, found.needed_gap_cm, found.needed_by_frame_m, found.binding_frame),
        (
            found.needed_hull_m,
            found.needed_hull_gap_cm,
            found.needed_hull_by_frame_m,
            found.binding_frame_hull,
        ),
    ):
        assert gap_cm == pytest.approx(18.0 + 100 * needed_m)
        assert by_frame_m.shape == (4,)
        assert by_frame_m[frame] == by_frame_m.max() == needed_m
        assert (by_frame_m >= found.range_m[0]).all()
    assert found.needed_hull_m >= found.needed_m


@pytest.mark.slow
@pytest.mark.thorough
def test_the_ball_and_the_curtain_are_sessions_with_a_scene(synth: Callable[..., Path]) -> None:
    for preset, names in (
        ("ball", ["ball"]),
        ("curtain", ["curtain_left", "curtain_right", "window"]),
    ):
        folder = synth(preset, "--n-frames", 3)

        session, truth = load_session(folder), read_truth(folder)
        scene = load_scene(folder / "scene.toml")
        assert [thing.name for thing in scene.objects] == list(truth.objects) == names
        for camera in session.cameras:
            assert camera.recording is not None
            assert camera.recording.count() == 3
        # In the middle the hands are in the curtain; the ball is touched before that and after.
        assert truth.objects[names[0]].collides.tolist() == [False, preset == "curtain", False]
        if preset == "curtain":
            (left, right, window) = scene.objects
            assert len(left.faces) + len(right.faces) == 720
            assert [effect["kind"] for effect in scene.effects] == ["cloth", "cloth"]
            assert left.recovery_direction is not None
            assert right.recovery_direction is not None
            assert left.recovery_direction.tolist() == [-1.0, 0.0, 0.0]
            assert right.recovery_direction.tolist() == [1.0, 0.0, 0.0]
            assert window.recovery_direction is None
            assert truth.spacing == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("boxes", "--participant", "2"), "preset 'boxes' has no option participant"),
        (("ball", "--gap-mm", "100"), "preset 'ball' has no option gap_mm; its options: none"),
        (("payload", "--participant", "5"), "participant is 5, expected 1 to 4"),
        (("payload", "--participant", "0"), "participant is 0, expected 1 to 4"),
        (("payload", "--gap-mm", "-10"), "gap_mm is -10, expected 60 to 400"),
        (("payload", "--gap-mm", "nan"), "gap_mm is nan, expected 60 to 400"),
        (("payloads",), "no preset 'payloads'; one of boxes, payload, ball, curtain, b"),
    ],
)
def test_what_a_preset_does_not_have_is_refused_in_one_line(
    run: Run,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    arguments: tuple[str, ...],
    message: str,
) -> None:
    status = run("synth", *arguments, "-o", tmp_path / "out")

    captured = capsys.readouterr()
    assert status == 1
    assert message in captured.err
    assert captured.err.strip().count("\n") == 0
    assert not (tmp_path / "out").exists()
