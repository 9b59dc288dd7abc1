# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop animate`: an episode without control, with LQT and with the adapted law, side by side.

All three begin with the same initial field and have one scale of colours. GIF always, by Pillow; MP4
where ffmpeg is installed.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.build import build_plant
from pdeloop.evaluation import another_loop
from pdeloop.finished_run import FinishedRun
from pdeloop.messages.files import write_atomically, writing_to
from pdeloop.method.seeds import Purpose, derive, evaluation_noise
from pdeloop.report.data import ProblemData, behaviours
from pdeloop.report.style import COLOURS, NAMES
from tuner_node.run_folder import RunFolderError

FRAMES_PER_SECOND = 12
HOLD = 2.0
"""Seconds for which the last picture of a GIF stays before it begins again."""
COLOURS_OF_A_GIF = 64
Pictures = list[NDArray[np.uint8]]


def animated(run: FinishedRun, *, field: int = 0, seconds: float = 6.0) -> Pictures:
    """The pictures of a run's controllers on one of the fields of its closing evaluation.

    run: a finished run, whose first seed is shown; field: its number; seconds: duration of the episode
    in the animation. Returns arrays (height, width, 3). ValueError if there is no such field, or the
    run had another plant or law than the built-in ones.
    """
    fields = int(run.values["evaluation_fields"])
    if not 0 <= field < fields:
        raise RunFolderError(
            f"field is {field}; the closing evaluation had fields 0 to {fields - 1}"
        )
    problem = ProblemData({"adapted": run}, [], 0, build_plant(run.values))
    if reason := another_loop(run):
        raise RunFolderError(f"{reason}, so it cannot be animated")
    return pictures(problem, field=field, seconds=seconds)


def pictures(problem: ProblemData, *, field: int = 0, seconds: float = 6.0) -> Pictures:
    """The same of a problem's part of a report."""
    from pdeloop.frames import Frames

    values, plant = problem.first.values, problem.plant
    seed = int(values["evaluation_seed"])
    start = derive(seed, Purpose.EVALUATION_FIELD, field)
    shown = behaviours(problem, start, evaluation_noise(seed, field + 1)[field])
    states = np.stack([b.states for b in shown])
    actions = np.stack([b.actions for b in shown])
    actions = np.nan_to_num(np.concatenate([actions, actions[:, -1:]], axis=1))
    titles = [
        f"{NAMES[b.controller]}: "
        + (f"diverges at step {b.diverged}" if b.diverged >= 0 else f"cost {b.cost:.3g}")
        for b in shown
    ]
    frames = Frames(
        plant,
        titles,
        [COLOURS[b.controller] for b in shown],
        fields=states,
        largest=float(np.abs(actions).max()),
    )
    count = max(2, min(plant.horizon + 1, round(seconds * FRAMES_PER_SECOND)))
    steps = np.rint(np.linspace(0, plant.horizon, count)).astype(int).tolist()
    return [frames.draw(states[:, k], actions[:, k], k) for k in steps]


def writes(path: Path) -> None:
    """ValueError unless an animation can be written as a file of this name."""
    suffix = path.suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path} is not an animation; expected a file that ends in .gif or .mp4")
    if suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise ValueError(
            f"{path} needs ffmpeg, which is not found; install it (apt install ffmpeg), or write a "
            f"GIF: {path.with_suffix('.gif').name}"
        )


def write(path: Path, drawn: Pictures) -> None:
    """Write pictures as the GIF or MP4 that the file's name says; see `writes`."""
    content = _gif(drawn) if path.suffix.lower() == ".gif" else _mp4(drawn)
    with writing_to(path, RunFolderError):
        write_atomically(path, content)


def _gif(drawn: Pictures) -> bytes:
    """One palette for all pictures, so that what does not move takes no room."""
    from PIL import Image

    strip = Image.fromarray(np.concatenate([drawn[0], drawn[len(drawn) // 2], drawn[-1]]))
    found = strip.quantize(COLOURS_OF_A_GIF, method=Image.Quantize.MEDIANCUT).getpalette() or []
    table, background = np.array(found, dtype=np.int64).reshape(-1, 3), drawn[0][0, 0]
    others = table[
        np.abs(table - background).max(axis=1) > 8
    ]  # Pillow does not tell nearer ones apart
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.vstack([background, others]).ravel().tolist())
    images = [
        Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in drawn
    ]
    duration = [round(1000 / FRAMES_PER_SECOND)] * len(images)
    duration[-1] = round(1000 * HOLD)
    file = io.BytesIO()
    images[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=images[1:],
        duration=duration,
        loop=0,
        optimize=False,
    )
    return file.getvalue()


def _mp4(drawn: Pictures) -> bytes:
    """By ffmpeg, which is fed with the raw pixels."""
    height, width = (size // 2 * 2 for size in drawn[0].shape[:2])  # which the format asks for
    with tempfile.TemporaryDirectory(prefix="pdeloop-") as folder:
        made = Path(folder) / "animation.mp4"
        command = ["ffmpeg", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
        command += ["-s", f"{width}x{height}", "-r", str(FRAMES_PER_SECOND), "-i", "-"]
        command += ["-pix_fmt", "yuv420p", "-movflags", "+faststart", str(made)]
        raw = b"".join(one[:height, :width].tobytes() for one in drawn)
        done = subprocess.run(command, input=raw, capture_output=True)
        if done.returncode or not made.exists():
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise RunFolderError(f"ffmpeg failed: {said[-1] if said else done.returncode}")
        return made.read_bytes()
