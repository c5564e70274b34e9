r"""A shot on an OpenCue farm: chunks of frames, each ``torchdof render --frames FIRST-LAST --resume``.

    python examples/farm/cue_job.py --image /shot/beauty.####.exr --depth /shot/depth.####.exr \
        --out /shot/dof.####.exr --frames 1-48 --show film --shot ab0010 -- --focus-m 1:2.0,48:5.5 --f-number 2

Arguments after ``--`` are options of ``torchdof render``. Needs pip install opencue-pyoutline opencue-pycue, and
torchdof on the machines of the farm. A chunk that runs again renders only the missing frames. ``--print`` shows the job
without sending it.
"""

import argparse
import shlex

import outline
import outline.backend.cue
import outline.cuerun
from outline.modules.shell import Shell

__all__ = ["job", "main"]


def job(
    image: str,
    depth: str | None,
    out: str,
    frames: str,
    options: list[str],
    chunk: int = 8,
    cores: int = 2,
    show: str = "testing",
    shot: str = "default",
) -> outline.cuerun.OutlineLauncher:
    """The job: one layer, whose frames Cuebot hands out in chunks.

    Args:
        image: All-in-focus frames, such as ``/shot/beauty.####.exr``.
        depth: Their depth; None uses the images' Z channel.
        out: Frames to write.
        frames: First and last, such as ``1-48``.
        options: Further options of ``torchdof render``.
        chunk: Frames of one task.
        cores: Cores of one task.
        show: Show in OpenCue.
        shot: Shot in OpenCue.
    """
    command = [
        "env",
        f"OMP_NUM_THREADS={cores}",
        "torchdof",
        "render",
        image,
        *([] if depth is None else [depth]),
        "--out",
        out,
        *options,
    ]
    words = " ".join(map(shlex.quote, command))
    layer = Shell(
        "torchdof",
        command=f"{words} --resume --frames #FRAME_START#-#FRAME_END#",
        range=frames,
        chunk=chunk,
        threads=cores,
    )
    shot_job = outline.Outline("torchdof", frame_range=frames, name_unique=False, show=show, shot=shot)
    shot_job.add_layer(layer)
    return outline.cuerun.OutlineLauncher(shot_job)


def main() -> None:
    """Send the job, or print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--image", required=True, help="all-in-focus frames, such as shot.####.exr")
    parser.add_argument("--depth", help="their depth; default: the images' Z channel")
    parser.add_argument("--out", required=True, help="frames to write")
    parser.add_argument("--frames", required=True, help="first and last, such as 1-48")
    parser.add_argument("--chunk", type=int, default=8, help="frames of one task")
    parser.add_argument("--cores", type=int, default=2, help="cores of one task")
    parser.add_argument("--show", default="testing")
    parser.add_argument("--shot", default="default")
    parser.add_argument("--print", action="store_true", dest="shown", help="show the job without sending it")
    parser.add_argument("options", nargs="*", help="options of torchdof render, after --")
    a = parser.parse_args()
    launcher = job(a.image, a.depth, a.out, a.frames, a.options, a.chunk, a.cores, a.show, a.shot)
    if a.shown:
        print(outline.backend.cue.serialize_simple(launcher))
    else:
        launcher.launch(use_pycuerun=False)


if __name__ == "__main__":
    main()
