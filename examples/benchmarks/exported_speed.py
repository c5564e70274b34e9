"""Time of files in onnxruntime and OpenVINO beside the module: ``python examples/benchmarks/exported_speed.py FILE``.

All are rendered in turns, and the medians told in milliseconds and in Y, the time of one depthwise 17 x 17 convolution
of 16 frames of 960 x 540 (``torchdof.bench.speed.unit_work``). With one thread it is the time of the processor, which
other programs disturb less, else the time of the clock. The scene is the built-in one of ``torchdof bench``, blurred up
to the largest radius of each file. ``--web FOLDER`` adds onnxruntime-web under Node, with one thread; FOLDER has
``node_modules/onnxruntime-web``.
"""

import argparse
import base64
import functools
import importlib.util
import json
import os
import statistics
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchdof import Camera, blur_by_coc
from torchdof.bench import exported
from torchdof.bench.inputs import shipped
from torchdof.bench.speed import unit_work
from torchdof.bench.timer import in_turns, processor_seconds
from torchdof.reference.degraded import KINDS, degrade

__all__ = ["feed_of", "main"]

Feed = dict[str, np.ndarray]
_FOCUS_M = 2.0


def feed_of(
    options: dict[str, Any], camera: Camera, size: tuple[int, int], in_focus: bool, kind: str = "exact"
) -> Feed:
    """Inputs of a file that takes depth, ``size`` rows and columns of the built-in scene, its depth made worse."""
    scene = shipped(*size)
    infinity_px = 1.05 * options["max_coc_px"]
    depth = degrade((_FOCUS_M / (1.0 - scene.coc_px.double() / infinity_px)).float(), kind)
    wide = camera.replace(focus_m=_FOCUS_M, f_number=1.0).coc_px(torch.full((1, 1, 1, 1), torch.inf), size[1])
    values = {"image": scene.image, "depth": torch.full_like(depth, _FOCUS_M) if in_focus else depth}
    values |= {"focus_m": torch.tensor([_FOCUS_M]), "f_number": wide.flatten() / infinity_px}
    return {name: value.float().numpy() for name, value in values.items()}


def openvino_model(path: str, threads: int) -> Callable[[Feed], Any]:
    """A file in OpenVINO on the CPU, in float32."""
    import openvino

    settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads}
    compiled = openvino.Core().compile_model(path, "CPU", settings)
    return lambda feed: compiled(feed)


def web_seconds(model: str, feed: Feed, node_folder: Path, runs: int) -> list[float]:
    """Seconds of the processor of each run in onnxruntime-web, under Node."""
    values = {
        name: {"dims": value.shape, "data": base64.b64encode(value.tobytes()).decode()} for name, value in feed.items()
    }
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "feed.json"
        inputs.write_text(json.dumps(values))
        call = ["node", str(Path(__file__).with_suffix(".mjs")), model, str(inputs), str(runs)]
        environment = os.environ | {"TORCHDOF_NODE_FOLDER": str(node_folder)}
        done = subprocess.run(call, env=environment, capture_output=True, text=True, check=True)
    return list(json.loads(done.stdout))


def main() -> None:
    """Print a line a rendering."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("models", nargs="+", help="files written by torchdof export, for the disc")
    parser.add_argument("--size", default="960x540", help="WIDTHxHEIGHT")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--depth", choices=KINDS, default="exact", help="how bad the depth is made; by default it is exact"
    )
    parser.add_argument("--runs", type=int, default=3, help="timed rounds after one to warm up; the median counts")
    parser.add_argument("--web", type=Path, metavar="FOLDER", help="also in onnxruntime-web, which is in this folder")
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.size.split("x"))
    torch.set_num_threads(arguments.threads)

    works: dict[str, Callable[[], Any]] = {"Y": unit_work()}
    on_web: dict[str, tuple[str, Feed]] = {}
    for model in arguments.models:
        runner, name = exported.session(model, arguments.threads), Path(model).stem
        facts = runner.get_modelmeta().custom_metadata_map
        camera, options = Camera(**json.loads(facts["torchdof.camera"])), json.loads(facts["torchdof.options"])
        feed, focused = (
            feed_of(options, camera, (height, width), in_focus, arguments.depth) for in_focus in (False, True)
        )
        works[f"{name}, onnxruntime"] = functools.partial(runner.run, None, feed)
        works[f"{name}, onnxruntime, in focus"] = functools.partial(runner.run, None, focused)
        on_web[f"{name}, onnxruntime-web"] = (model, feed)
        if importlib.util.find_spec("openvino") is not None:
            works[f"{name}, OpenVINO"] = functools.partial(openvino_model(model, arguments.threads), feed)
        scene = shipped(height, width).blurred(options["max_coc_px"])
        called = {key: options[key] for key in ("occlusion", "tolerance")}
        works[f"{name}, the module"] = functools.partial(blur_by_coc, scene.image, scene.coc_px, **called)

    clock = {"seconds_of": processor_seconds} if arguments.threads == 1 else {}
    with torch.inference_mode():
        taken = in_turns(works, arguments.runs, **clock)
    if arguments.web is not None:
        for name, (model, feed) in on_web.items():
            taken[name] = web_seconds(model, feed, arguments.web.resolve(), arguments.runs)
    unit = statistics.median(taken["Y"])
    for name, seconds in taken.items():
        middle = statistics.median(seconds)
        print(f"{name:40} {1000 * middle:8.1f} ms {middle / unit:7.2f} Y")


if __name__ == "__main__":
    main()
