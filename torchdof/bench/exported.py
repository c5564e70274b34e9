"""Time and memory of a file: ``python -m torchdof.bench.exported dof.onnx --size 1920x1080``.

Each scene runs in onnxruntime alone, in a process of its own, so that the peak of its memory is the runtime's.
"""

import argparse
import json
import subprocess
import sys

import numpy as np
import onnxruntime

from torchdof.bench import memory
from torchdof.bench.timer import median_and_spread, times

__all__ = ["main", "measure_file"]

SCENES = ("all in focus", "blurred background", "all blurred")


def measure_file(path: str, size: tuple[int, int], scene: str, threads: int = 2, runs: int = 3) -> dict[str, float]:
    """Median time and peak memory of one frame, in a process of its own.

    Args:
        path: A file of :func:`torchdof.export.to_onnx` whose image has 3 channels.
        size: Height and width.
        scene: One of :data:`SCENES`.
        threads: Of onnxruntime.
        runs: Timed runs after one more to warm up.

    Returns:
        ``seconds`` a frame, and ``peak_gb`` of memory of the whole process.

    Raises:
        ValueError: If the process fails; with what it said.
    """
    call = [sys.executable, "-m", "torchdof.bench.exported", path, "--alone", scene]
    call += ["--size", f"{size[1]}x{size[0]}", "--threads", str(threads), "--runs", str(runs)]
    done = subprocess.run(call, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"rendering with {path} failed: {done.stderr[-1000:]}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def feed(session: onnxruntime.InferenceSession, size: tuple[int, int], scene: str) -> dict[str, np.ndarray]:
    """Inputs of a scene: an image of noise, and depths that reach to the largest radius of the file."""
    facts = session.get_modelmeta().custom_metadata_map
    camera, reach = json.loads(facts["torchdof.camera"]), json.loads(facts["torchdof.options"])["max_coc_px"]
    height, width = size
    fraction = np.zeros((1, 1, height, width), np.float32)  # of the largest radius
    if scene == "blurred background":
        fraction[..., width // 2 :] = np.linspace(0.0, 0.95, width - width // 2, dtype=np.float32)
    elif scene == "all blurred":
        fraction[:] = np.linspace(0.6, 0.95, width, dtype=np.float32)
    values = {"image": np.random.default_rng(0).random((1, 3, height, width), dtype=np.float32)}
    if "coc_px" in {value.name for value in session.get_inputs()}:
        return values | {"coc_px": reach * fraction}
    focus_m, focal_m = 2.0, camera["focal_length_mm"] / 1000
    image_m = focus_m * focal_m / (focus_m - focal_m) if camera["focus_breathing"] else focal_m
    pitch_m = camera["sensor_width_mm"] / 1000 / width
    aperture_m = 2 * reach * pitch_m * focus_m / image_m  # the coc of infinity is the largest radius
    values["depth"] = (focus_m / (1.0 - fraction)).astype(np.float32)
    values["focus_m"] = np.full(1, focus_m, np.float32)
    values["f_number"] = np.full(1, focal_m / aperture_m, np.float32)
    return values


def session(path: str, threads: int) -> onnxruntime.InferenceSession:
    """On the CPU, with so many threads, without a second block of memory of the size that the first frame took."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    options.enable_mem_pattern = False
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def main() -> None:
    """Print a line a scene; with PyTorch's time beside it where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("model", help="file written by torchdof export")
    parser.add_argument("--size", default="1920x1080", help="WIDTHxHEIGHT")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--runs", type=int, default=3, help="timed runs after one to warm up; the median counts")
    parser.add_argument("--torch", action="store_true", help="also time eager PyTorch, as the file's options say")
    parser.add_argument("--alone", choices=SCENES, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.size.split("x"))
    if arguments.alone:
        runner = session(arguments.model, arguments.threads)
        inputs = feed(runner, (height, width), arguments.alone)
        seconds = median_and_spread(times(lambda: runner.run(None, inputs), arguments.runs))[0]
        print(json.dumps({"seconds": seconds, "peak_gb": memory.peak_mb() * 2**20 / 1e9}))
        return
    print(f"{width} x {height}, {arguments.threads} threads, onnxruntime {onnxruntime.__version__}")
    for scene in SCENES:
        got = measure_file(arguments.model, (height, width), scene, arguments.threads, arguments.runs)
        line = f"{scene:20} onnxruntime {got['seconds']:7.2f} s, peak {got['peak_gb']:.2f} GB"
        if arguments.torch:
            line += ", eager PyTorch {:7.2f} s, with the file's layers {:7.2f} s".format(
                *_torch_seconds(arguments.model, (height, width), scene, arguments.threads, arguments.runs)
            )
        print(line, flush=True)


def _torch_seconds(path: str, size: tuple[int, int], scene: str, threads: int, runs: int) -> tuple[float, float]:
    """Eager PyTorch planning for the scene, and with the layers of the file. The table is the disc, as timing goes."""
    import torch

    from torchdof import Camera, DepthOfField
    from torchdof.render.plan import Plan

    torch.set_num_threads(threads)
    runner = session(path, threads)
    facts = runner.get_modelmeta().custom_metadata_map
    dof = DepthOfField(
        Camera(**json.loads(facts["torchdof.camera"])), **json.loads(facts["torchdof.options"]), check=False
    )
    tensors = [torch.from_numpy(value) for value in feed(runner, size, scene).values()]
    if len(tensors) != 4:
        raise ValueError("PyTorch is timed for files that take depth")
    plan = Plan.all(dof.options.max_coc_px, dof.options.tolerance, rays=True)
    with torch.no_grad():
        planned, _ = median_and_spread(times(lambda: dof(*tensors), runs))
        fixed, _ = median_and_spread(times(lambda: dof(*tensors, plan=plan), runs))
        return planned, fixed


if __name__ == "__main__":
    main()
