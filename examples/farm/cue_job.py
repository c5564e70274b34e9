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
    command = ["env", f"OMP_NUM_THREADS={a.cores}", "torchdof", "render", a.image, *([a.depth] if a.depth else [])]
    words = shlex.join([*command, "--out", a.out, *a.options])
    words += " --resume --frames #FRAME_START#-#FRAME_END#"
    shot_job = outline.Outline("torchdof", frame_range=a.frames, name_unique=False, show=a.show, shot=a.shot)
    shot_job.add_layer(Shell("torchdof", command=words, range=a.frames, chunk=a.chunk, threads=a.cores))
    launcher = outline.cuerun.OutlineLauncher(shot_job)
    if a.shown:
        print(outline.backend.cue.serialize_simple(launcher))
    else:
        launcher.launch(use_pycuerun=False)


if __name__ == "__main__":
    main()
