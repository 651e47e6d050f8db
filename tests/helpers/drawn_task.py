"""A generated task as ready masks: true silhouettes whose outlines may err, and its layout as CAD.

No picture is rendered, and the rig is the true one: what is asked again and again of one recording
costs only its evaluation.
"""

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from helpers.seen import Drawn
from hybridve.calib.formats.rig_json import write_rig
from hybridve.calib.lens import undistortion
from hybridve.calib.rig import Rig
from hybridve.hull.query.silhouettes import make_views
from hybridve.hull.synth.meshes import write_stl
from hybridve.hull.synth.presets import PRESETS


class DrawnTask:
    """The task of a preset as one participant does it, in `n_frames` frames.

    Parameters
    ----------
    preset : str
        Which.
    n_frames : int, optional
        In how many frames the whole motion is seen; by default those of the preset.
    shrink : int
        Cameras have so many times fewer pixels each way.
    **options : float
        Of the preset.
    """

    def __init__(
        self, preset: str, n_frames: int | None = None, *, shrink: int = 1, **options: float
    ) -> None:
        chosen = PRESETS[preset]
        values = {one.name: one.default for one in chosen.options} | options
        self._stage = chosen.make_stage(**values)
        self._cameras = tuple(
            replace(
                camera,
                model="PINHOLE",
                width_px=camera.width_px // shrink,
                height_px=camera.height_px // shrink,
                params=camera.params[:4] / shrink,
            )
            for camera in self._stage.cameras
        )
        self.n_frames = chosen.n_frames if n_frames is None else n_frames
        self.fps = chosen.fps * self.n_frames / chosen.n_frames

    @cached_property
    def _drawn(self) -> Drawn:
        lenses = [undistortion(camera) for camera in self._cameras]
        views = make_views(
            tuple(camera.name for camera in self._cameras),
            np.array([(lens.width_px, lens.height_px) for lens in lenses], np.int64),
            np.array(
                [
                    lens.img_from_cam @ camera.cam_from_world
                    for camera, lens in zip(self._cameras, lenses, strict=True)
                ]
            ),
        )
        same = self._cameras, self._cameras, views, lenses
        return Drawn(self._stage, *same, self.n_frames, self.fps, 0.0, 0.0)

    def write_session(self, folder: Path, std_px: float = 0.0, seed: int = 0) -> Path:
        """Write the masks, whose outlines err by a normal error, another one in each frame."""
        drawn = self._drawn
        drawn._std_px, drawn.seed = std_px, seed
        folder.mkdir(parents=True, exist_ok=True)
        write_rig(folder / "rig.json", Rig(self._cameras))
        lines = [
            'format = "hybridve-session"',
            "version = 1",
            f"fps = {self.fps!r}",
            'rig = "rig.json"',
        ]
        for number, camera in enumerate(self._cameras):
            (folder / camera.name).mkdir(exist_ok=True)
            for frame in range(self.n_frames):
                mask = 255 * drawn.seen(number, float(frame))
                cv2.imwrite(str(folder / camera.name / f"{frame:03d}.png"), mask)
            lines += ["[[camera]]", f'name = "{camera.name}"', f'masks = "{camera.name}/*.png"']
        path = folder / "session.toml"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    def write_scene(
        self,
        folder: Path,
        moved_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
        name: str = "scene.toml",
        rules: str = "",
        only: str = "",
    ) -> Path:
        """Write the layout, its parts (or only one of them) moved."""
        folder.mkdir(parents=True, exist_ok=True)
        lines = ['format = "hybridve-scene"', "version = 1", rules]
        for part in self._stage.parts:
            write_stl(folder / f"{part.name}.stl", part.mesh, part.name)
            by_mm = moved_mm if only in ("", part.name) else (0.0, 0.0, 0.0)
            place = np.array(part.translate_mm) + by_mm
            lines += [
                "[[object]]",
                f'name = "{part.name}"',
                f'mesh = "{part.name}.stl"',
                'unit = "mm"',
                f"translate_mm = {place.tolist()}",
                f"rotate_deg = {list(part.rotate_deg)}",
                f"required_clearance_mm = {part.required_clearance_mm!r}",
            ]
        path = folder / name
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path
