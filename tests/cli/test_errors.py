"""Bad input gives exit code 2 and one sentence on standard error, and no file is written."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdof.io.images import Picture, write_image

_RENDER = """
none.exr depth.npy --focus-m 2                        | none.exr: there is no such file
image.exr --focus-m 2                                 | image.exr: has no depth channel; name a depth file
a.png                                                 | IMAGE DEPTH, which a network such as Depth Anything makes of it
image.exr turned.npy --focus-m 2                      | turned by 90 degrees it fits
image.exr small.npy --focus-m 2                       | small.npy: depth is 3 x 4 pixels and the image 24 x 16
image.exr small.npy --depth-kind coc                  | small.npy: coc is 3 x 4 pixels but the image is 24 x 16
image.exr holed.npy --focus-m 2                       | holed.npy: 2 pixels (0.5 %) have no depth
image.exr unknown.npy --focus-m 2                     | unknown.npy: no pixel has a depth; check the kind
image.exr partly.npy --depth-kind coc                 | have no depth (NaN or marked unknown); say how to fill them: fi
image.exr millimetres.npy --focus-at 3,3 --depth-scale 1e-6 | --focus-m must be longer than the focal length
image.exr depth.####.npy --focus-m 2                  | image.exr: is a single image
shot.####.exr none.####.npy --focus-m 2 -o o.#.exr    | none.0001.npy: there is no such file
none.####.exr depth.npy --focus-m 2 -o o.#.exr        | none.####.exr: there are no such files
shot.####.exr depth.npy --focus-m 2 -o shot.####.exr  | shot.0001.exr: is one of the inputs
shot.####.exr depth.npy --focus-m 2 -o o.#.exr --frames 1-300000000 | 299999997 of 300000000 frames are missing, shot.
shot.####.exr none.####.npy -o o.#.exr --frames 1-2   | none.####.npy: 2 of 2 frames are missing, none.0001.npy first;
image.exr depth.npy --focus-m 1:2,3:4 -o o.#.exr --frames 1-300000000 | 1-300000000 are 300000000 frames, more than
nowhere depth.npy                                     | nowhere: a file without a suffix is not an image that can be
. depth.npy                                           | depth.npy: with a folder of images, DEPTH is the folder of
image.exr .                                           | .: is a folder; name a file in it, or a sequence as
image.exr shot.0003.exr --focus-m 1:2,3:4 -o shot.####.exr | shot.0003.exr: is one of the inputs
shot.####.exr depth.####.npy -o o.#.exr --depth-kind coc --steady | --steady filters depth in metres
shot.%099999999d.exr depth.npy --focus-m 2            | must have at most 18 digits
image.exr depth.npy --focus-m 2 -o depth.npy/out.exr  | its folder cannot be made
image.exr depth.npy --focus-m 2 --sheet image.exr     | image.exr: is one of the inputs
image.exr depth.npy --focus-m 2 --sheet ./out.exr     | out.exr: would be written twice
image.exr depth.npy --focus-m 2 -o out.gif            | cannot write files of type '.gif'
shot.####.exr depth.npy -o o.#.exr                    | where is the focus? give --focus-m METRES or --focus-at X,Y
image.exr depth.npy --focus-m near                    | --focus-m expects METRES such as 2.0, or keyframes
image.exr depth.npy --focus-m 1:2,5:3                 | such as pull.##.png; ffmpeg joins frames
image.exr depth.npy --focus-m 1:2,5:3 -o o.#.exr --sheet s.png | --sheet is of one picture
image.exr depth.npy --focus-at 3                      | --focus-at expects X,Y such as 320,200, got '3'
image.exr depth.npy --focus-at 99,5                   | focus point (99.0, 5.0) must lie in the frame of 24 x 16
image.exr depth.npy --focus-m 2 --focus-at 3,3        | --focus-m and --focus-at both say where to focus
image.exr depth.npy --focus-range 2,1                 | --focus-range must go from near to far
image.exr depth.npy --focus-m 2 --tilt 95             | --tilt must be in (-90, 90) degrees
image.exr depth.npy --focus-m 2 --f-number 1e-42      | this lens (--focal-length-mm 50, --f-number 1e-42,
image.exr depth.npy --focus-m 2 --fov-deg 40          | --fov-deg needs the opening of the lens
image.exr depth.npy --focus-m 2 --fov-deg 40 --focal-length-mm 50 | say the same; give one of them
image.exr depth.npy --focus-m 2 --fov-deg 40 --f-number 2 --aperture-radius-m 1 | both say how wide the lens opens
image.exr depth.npy --focus-m 2 --fov-deg 40 --aperture-radius-m 1e45 | check this lens (--focal-length-mm 49.4
image.exr depth.npy --focus-m 2 --f-number 2 --blur 2% | --f-number and --blur both say how wide the lens opens
image.exr depth.npy --focus-m 2 --equivalent 85,1.4 --focal-length-mm 50 | --equivalent and --focal-length-mm say
image.exr depth.npy --focus-m 2 --equivalent 85       | --equivalent expects MM,F such as 85mm,1.4, got '85'
image.exr depth.npy --focus-m 2 --blur 99%            | --blur expects SHARE% such as 2%, above 0 and at most 50%
image.exr depth.npy --focus-m 2 --blur 0.5            | --blur expects SHARE% such as 2%
image.exr depth.npy --depth-kind coc --blur 2%        | --depth-kind coc is the blur itself and takes no camera
shot.####.exr depth.npy -o o.#.exr --focus-m 2 --blur 2% | --blur would open the lens anew in each frame
image.exr depth.npy --focus-m 2 --aperture-radius-m 1 | --aperture-radius-m goes with --fov-deg
image.exr depth.npy --focus-m 2 --fill-depth x        | --fill-depth expects nearest|far|METRES, got 'x'
image.exr depth.npy --focus-m 2 --fill-depth 1e-45 --depth-unknown 6 | which starts at 1.4e-45 m
image.exr depth.npy --focus-m 2 --depth-kind disparity | disparity needs a scale (--depth-scale)
image.exr depth.npy --focus-m 2 --depth-kind distance | --depth-kind distance needs --fov-deg
image.exr depth.npy --focus-m 2 --depth-kind relative --near-m 1 --far-m 2 --depth-scale 3 | near and far say it
image.exr depth.npy --focus-m 2 --depth-kind relative --near-m 5 --far-m 1 | depth.npy: near_m must be nearer than
image.exr depth.npy --focus-m 2 --near-m 1 --depth-kind z | are for relative depth, and not for --depth-kind z
image.exr millimetres.npy --focus-m 3 --f-number 1.4 --strict | millimetres.npy: the focus at 3 m is nearer than all
image.exr depth.npy --focus-m 2 --table nowhere       | no blur table 'nowhere': neither a file nor one of the shipped
image.exr depth.npy --focus-m 2 --attention 3,4,0     | (x, y, radius) in pixels, radius > 0
image.exr depth.npy --focus-m 2 --lights 3            | --lights is for photographs of 8 or 16 bits
image.exr depth.npy --focus-m 2 --tolerance best      | --tolerance expects draft|preview|final|NUMBER
image.exr depth.npy --focus-m 2 --device warp         | --device warp: there is no such device
image.exr depth.npy --focus-m 2 --rotation 5          | --rotation turns blades or an image
image.exr depth.npy --focus-m 2 --squeeze 0           | --squeeze must be a number from 0.1 to 10
image.exr depth.npy --focus-m 2 --blades 5 --aperture a.png | --aperture is the whole opening
"""

_OTHERS = """
inspect image.exr                                | image.exr: has no depth channel
inspect image.exr depth.npy -o image.exr         | image.exr: is one of the inputs
inspect image.exr zeros.npy                      | zeros.npy: no pixel has a depth
inspect image.exr depth.npy --depth-kind coc     | there is no depth to inspect
inspect image.exr depth.npy --focus-m 1:2,3:4    | --focus-m has keyframes but IMAGE is a single image
tables nothing                                   | no blur table 'nothing'
bench --focus-m 2                                | the built-in scene has its own camera and depth
bench image.exr depth.npy --truth .              | leave IMAGE and DEPTH out
bench image.exr depth.npy --out image.exr        | its folder cannot be made
bench --truth . --out . --f-number 2             | with their own lens and depth
bench --vignetting 0.4 --onnx                    | one kernel a layer
bench image.exr depth.npy --views 4              | name its folder with --truth
bench a.png tiny.npy --depth-kind z              | from 16 pixels a side on
bench --truth .                                  | give a folder with --out
bench --truth . --json                           | leave --json out
bench --truth . --scan                           | leave IMAGE and DEPTH out, --onnx, --compile and --scan
export                                           | give either -o FILE to write or --show FILE to read
export -o dof.bin                                | name it dof.onnx
export -o dof.onnx --table double_gauss_50mm_f2  | state it as --width=1920
export -o dof.onnx --max-coc 0.2                 | --max-coc must be
export -o nowhere/dof.onnx                       | there is no folder
export --show none.onnx                          | there is no file none.onnx
fit                                              | either a folder of captures or --lens
fit nowhere                                      | capture.toml
fit --lens nowhere                               | nowhere
fit nowhere -o table.txt                         | name it table.json
fit nowhere --target other.pdf                   | --target writes the page to print
fit --lens double_gauss_50mm --root .            | --root is the folder of photographs
fit --lens double_gauss_50mm --wavelengths red   | --wavelengths expects rgb|UM,UM,... such as
fit --lens double_gauss_50mm --field 0,6 --field-deg 5 | give one of them
fit --lens double_gauss_50mm --field 0,12,6      | --field must be increasing distances in mm
fit --lens double_gauss_50mm --focus-m 0.01      | --focus-m must be
"""


def rows(table: str) -> list[tuple[str, str]]:
    return [(line.partition("|")[0].strip(), line.partition("|")[2].strip()) for line in table.strip().splitlines()]


@pytest.fixture
def files(scene: Path) -> Path:
    depth = np.load("depth.npy")
    np.save("small.npy", np.ones((4, 3)))
    np.save("tiny.npy", np.ones((4, 4)))
    np.save("turned.npy", depth[0, 0].T)
    np.save("zeros.npy", 0 * depth)
    np.save("millimetres.npy", 1000 * depth)
    np.save("unknown.npy", np.nan * depth)
    np.save("partly.npy", np.where(depth < 3, depth, np.nan))
    depth[0, 0, 3, 4:6] = 0
    np.save("holed.npy", depth)
    write_image("a.png", Picture(torch.ones(1, 3, 4, 4)))
    return scene


@pytest.mark.parametrize(
    ("line", "expected"), [(f"render -o out.exr {line}", told) for line, told in rows(_RENDER)] + rows(_OTHERS)
)
def test_an_error_is_one_sentence_with_names_of_options(
    files: Path, run: Callable[..., str], line: str, expected: str
) -> None:
    before = {path: path.read_bytes() for path in files.rglob("*")}
    message = run(line, code=2)
    assert message.startswith("error: ") and expected in message and message.count("\n") == 1, message
    assert {path: path.read_bytes() for path in files.rglob("*")} == before
    of_library = ("coc_px", "check=False", "f_number", "focus_m", "_mm", "_deg")
    assert line.startswith("export") or not any(word in message for word in of_library)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("render image.exr", "Missing option '--out' / '-o'"),
        (
            "render image.exr depth.npy -o out.exr --f-number wide",
            "--f-number expects N such as 1.8 or f/1.8, got 'wide'",
        ),
        ("render image.exr depth.npy -o out.exr --depth-kind odd", "'odd' is not one of 'auto', 'z', 'distance'"),
        ("bench --repeat 0", "0 is not in the range x>=1"),
        ("render image.exr depth.npy -o out.exr --fov-deg 200", "'--fov-deg': 200.0 is not in the range 0<x<180"),
        ("render image.exr depth.npy -o out.exr --lights -1", "'--lights': -1.0 is not in the range x>=0"),
        ("fit --lens double_gauss_50mm --field-deg 95", "'--field-deg': 95.0 is not in the range 0<=x<90"),
        ("nonsense", "No such command 'nonsense'"),
        ("image.exr depth.npy -o out.exr", "to blur a picture: torchdof render image.exr DEPTH -o OUT"),
    ],
)
def test_wrong_usage_names_the_option_or_command(run: Callable[..., str], line: str, expected: str) -> None:
    message = run(line, code=2)
    assert expected in message and "Traceback" not in message
