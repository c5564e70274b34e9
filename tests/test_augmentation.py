"""``RandomDepthOfField`` as one of Kornia's augmentations and as a transform of torchvision."""

import functools
import pickle
from typing import Any

import kornia.augmentation as K
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.refused import refuses
from torchdof import BlurTable, Camera, DepthOfField, depth_of_field
from torchdof.augmentation import DepthAugmentationSequential, RandomDepthOfField
from torchdof.io.transfer import decode, encode

CAMERA = Camera(sensor_width_mm=4.0)
# Kornia 0.8 does not pass align_corners for masks
pytestmark = pytest.mark.filterwarnings("ignore:Default grid_sample and affine_grid behavior:UserWarning")


def sample(count: int = 4) -> tuple[Tensor, Tensor]:
    return torch.rand(count, 3, 18, 24), 0.6 + 3 * torch.rand(count, 1, 18, 24)


def random_dof(**changes: Any) -> RandomDepthOfField:
    return RandomDepthOfField(**{"camera": CAMERA, "p": 1.0, **changes})


def test_encoded_images_are_blurred_in_linear_light() -> None:
    image, depth = sample()
    aug = random_dof()
    out = aug(image, depth)
    linear = random_dof(transfer="linear")(decode(image, "srgb", False, False), depth, params=aug._params)
    assert torch.equal(out, encode(linear, "srgb", False, False))


def test_draws_lie_in_their_ranges_and_differ() -> None:
    aug = random_dof(focus_m=(0.5, float("inf")), f_number=(1.4, 8.0), table=[BlurTable.disc()] * 3)
    drawn = aug.forward_parameters((500, 3, 4, 5))
    assert 0.5 <= float(drawn["focus_m"].min()) < 0.51 and float(drawn["focus_m"].max()) > 20
    assert 1.4 <= float(drawn["f_number"].min()) < 1.45 and 7.8 < float(drawn["f_number"].max()) <= 8.0
    assert float((drawn["f_number"] < (1.4 * 8) ** 0.5).float().mean()) == pytest.approx(0.5, abs=0.1)  # stops
    assert drawn["table"].bincount().tolist() == pytest.approx([167] * 3, abs=50)


def test_each_image_is_blurred_by_the_lens_that_was_drawn_for_it() -> None:
    image, depth = sample()
    tables = [BlurTable.disc(), BlurTable.gaussian()]
    aug = random_dof(table=tables)
    drawn = {**aug.forward_parameters(tuple(image.shape)), "table": torch.tensor([0, 1, 1, 0])}
    out = aug(image, depth, params=drawn)
    for k, table in enumerate(tables):
        alone = random_dof(table=table)(image, depth, params={**drawn, "table": torch.zeros(4, dtype=torch.long)})
        assert torch.equal(out[drawn["table"] == k], alone[drawn["table"] == k])


def test_a_camera_with_numbers_for_each_image_is_that_of_the_drawn_ones() -> None:
    image, depth = sample()
    camera = Camera(sensor_width_mm=torch.tensor([3.0, 4.0, 5.0, 6.0]))
    aug = random_dof(camera=camera, p=0.5, return_label=True)
    params = aug.forward_parameters(image.shape) | {"batch_prob": torch.tensor([0.0, 1.0, 0.0, 1.0])}
    out, label = aug(image, depth, params=params)
    whole, whole_label = random_dof(camera=camera, return_label=True)(image, depth, params=params)
    assert_close(out, torch.stack([image[0], whole[1], image[2], whole[3]]))
    assert_close(label["coc_px"][1::2], whole_label["coc_px"][1::2])


@pytest.mark.parametrize("shape", [(4, 18, 24), (1, 1, 18, 24)])
def test_depth_may_lack_its_channel_or_be_shared(shape: tuple[int, ...]) -> None:
    image, depth = sample()
    depth = depth[: shape[0]]
    aug = random_dof()
    expected = aug(image, depth.expand(4, -1, -1, -1))
    assert torch.equal(aug(image, depth.reshape(shape), params=aug._params), expected)


def test_one_image_keeps_its_shape_or_becomes_a_batch_and_a_dict_is_accepted() -> None:
    image, depth = sample(1)
    aug = random_dof(keepdim=True)
    out = aug(image[0], depth[0])
    assert out.shape == (3, 18, 24)
    assert torch.equal(random_dof()(image[0], depth[0, 0], params=aug._params)[0], out)
    given = aug({"image": image[0], "depth": depth[0]})
    assert torch.equal(given["image"], aug(image[0], depth[0], params=aug._params)) and given["depth"] is not None
    given = random_dof(keepdim=True, return_label=True)({"image": image[0], "depth": depth[0], "index": 3})
    assert given["image"].shape == (3, 18, 24) and given["coc_px"].shape == (1, 18, 24) and given["index"] == 3
    assert given["focus_m"].shape == given["f_number"].shape == given["table"].shape == () and bool(given["blurred"])


# Labels


def test_the_label_holds_the_blur_and_the_random_parameters_with_which_the_picture_is_rendered() -> None:
    image, depth = sample()
    torch.manual_seed(2)
    options: dict[str, Any] = {"depth_edges": "as given", "tolerance": "preview"}
    aug = random_dof(p=0.5, transfer="linear", return_label=True, table=[BlurTable.disc()] * 3, **options)
    out, label = aug(image, depth)
    left_out = ~label["blurred"]
    assert label.keys() == {"coc_px", "focus_m", "f_number", "table", "blurred"} and 0 < int(left_out.sum()) < 4
    lens = {name: label[name] for name in ("focus_m", "f_number")}
    expected = DepthOfField(CAMERA).coc_px(image, depth, **lens)
    assert_close(label["coc_px"][label["blurred"]], expected[label["blurred"]])
    assert not bool(label["coc_px"][left_out].any()) and torch.equal(out[left_out], image[left_out])
    rendered = depth_of_field(image[~left_out], depth[~left_out], CAMERA, **options, **{
        name: values[~left_out] for name, values in lens.items()
    })  # fmt: skip
    assert torch.equal(out[~left_out], rendered)
    again, same = aug(image, depth, params=aug._params)
    assert torch.equal(again, out) and all(torch.equal(same[name], label[name]) for name in label)


def test_the_label_of_a_sequence_is_asked_for_after_it() -> None:
    image, depth = sample()
    dof = random_dof(p=0.5)
    pipeline = DepthAugmentationSequential(K.RandomHorizontalFlip(p=1.0), dof, data_keys=["input", "mask"])
    _, moved = pipeline(image, depth)
    drawn: Any = pipeline._params
    label = dof.label(image.flip(-1), moved, drawn[1].data)
    both = dof.label(torch.cat([image.flip(-1), moved], 1), params=drawn[1].data)
    assert label["coc_px"].shape == moved.shape
    assert all(torch.equal(label[name], both[name]) for name in label)


# Kornia's containers


def test_image_depth_and_masks_stay_aligned() -> None:
    image, depth = sample()
    labels = (depth > 2).float()
    moves = (K.RandomHorizontalFlip(p=0.5), K.RandomAffine(20.0, p=1.0), K.RandomResizedCrop((12, 16)))
    dof = random_dof()
    pipeline = DepthAugmentationSequential(*moves, dof, data_keys=["input", "mask", "mask"])
    out, moved, moved_labels = pipeline(image, depth, labels)
    assert out.shape == (4, 3, 12, 16) and moved.shape == moved_labels.shape == (4, 1, 12, 16)
    assert torch.equal(moved_labels, (moved > 2).float())
    assert set(moved.unique().tolist()) <= {0.0, *depth.unique().tolist()}  # depth is not interpolated
    drawn = pipeline._params or []
    sharp, same = K.AugmentationSequential(*moves, data_keys=["input", "mask"])(image, depth, params=drawn[:3])
    assert torch.equal(same, moved)
    assert torch.equal(out, dof(sharp, moved, params=drawn[3].data))
    again = pipeline(image, depth, labels, params=drawn)
    assert all(torch.equal(a, b) for a, b in zip(again, (out, moved, moved_labels), strict=True))


@pytest.mark.parametrize("container", ["image", "augmentation", "video"])
def test_the_fourth_channel_goes_through_kornias_own_containers(container: str) -> None:
    image, depth = sample()
    steps, dof = K.RandomHorizontalFlip(p=1.0), random_dof(same_on_batch=True)
    both = torch.cat([image, depth], dim=1)
    out: Any
    if container == "image":
        out = K.ImageSequential(steps, dof)(both)
    elif container == "video":
        out = K.VideoSequential(steps, dof, data_format="BTCHW")(both[None])[0]
    else:
        out, mask = K.AugmentationSequential(steps, dof, data_keys=["input", "mask"])(both, depth)
        assert torch.equal(mask, depth.flip(-1))
    assert torch.equal(out[:, 3:], depth.flip(-1))
    drawn = {name: dof._params[name][:1].expand(4) for name in ("focus_m", "f_number", "table", "batch_prob")}
    assert torch.equal(out[:, :3], dof(image.flip(-1), depth.flip(-1), params=drawn))


# torchvision's Compose, and workers of a DataLoader


def test_torchvision_composes_dicts_of_its_tensors() -> None:
    v2 = pytest.importorskip("torchvision.transforms.v2", reason="torchvision is not installed")
    tv = pytest.importorskip("torchvision.tv_tensors", reason="torchvision is not installed")
    image, depth = sample(1)
    dof = random_dof()
    pipeline = v2.Compose([v2.RandomHorizontalFlip(p=1.0), dof, v2.Normalize([0.5] * 3, [0.5] * 3)])
    data = {"image": tv.Image(image[0]), "depth": tv.Mask(depth[0, 0]), "labels": tv.Mask(depth[0]), "index": 3}
    out = pipeline(data)
    assert isinstance(out["image"], tv.Image) and isinstance(out["depth"], tv.Mask) and out["index"] == 3
    assert torch.equal(out["depth"], depth[0, 0].flip(-1)) and torch.equal(out["labels"], depth[0].flip(-1))
    expected = dof(image.flip(-1), depth.flip(-1), params=dof._params)[0]
    assert torch.equal(out["image"].as_subclass(Tensor), (expected - 0.5) / 0.5)


def test_draws_come_from_the_generator_that_a_data_loader_seeds_for_each_of_its_workers() -> None:
    image, depth = sample(1)
    blur = pickle.loads(pickle.dumps(random_dof(keepdim=True, table=[BlurTable.load("sato_j15")])))
    images = []
    for seed in (5, 6, 5):
        torch.manual_seed(seed)
        images += [blur(image[0], depth[0]) for _ in range(4)]
    assert all(map(torch.equal, images[:4], images[8:]))
    assert len(torch.stack(images).flatten(1).unique(dim=0)) == 8


# Error messages

IMAGE, DEPTH = sample()
partial: Any = functools.partial
test_errors_name_the_argument = refuses(
    (partial(RandomDepthOfField, focus_m=(5.0, 0.5)), "focus_m must be two numbers, the smallest first"),
    (partial(RandomDepthOfField, focus_m=(0.04, 5.0)), "focus_m must be longer than the focal length"),
    (partial(RandomDepthOfField, f_number=(1.4, float("inf"))), "f_number must be a number"),
    (partial(RandomDepthOfField, table=["disc"]), "table must be a torchdof.BlurTable, got str"),
    (partial(RandomDepthOfField, transfer="gamma"), "transfer must be one of linear, srgb"),
    (partial(RandomDepthOfField, p=True), "p must be a probability from 0 to 1"),
    (partial(RandomDepthOfField, return_label=1), "return_label must be True or False"),
    (lambda: K.AugmentationSequential(random_dof(), data_keys=["input", "mask"])(IMAGE, DEPTH),
     r"needs a depth: .*DepthAugmentationSequential.*3 channels alone"),
    (lambda: random_dof()((IMAGE, DEPTH)), "takes a dict, or image and depth as two arguments, got a tuple"),
    (lambda: random_dof()(IMAGE[None], DEPTH[None]), r"clips: flatten\(0, 1\).* got a torch.float32"),
    (lambda: random_dof()(IMAGE[0].numpy(), DEPTH), r"got a float32 array of shape \[.*; use torch.from_numpy"),
    (lambda: random_dof()(IMAGE.byte(), DEPTH), r"bytes: image.float\(\) / 255.* got a torch.uint8"),
    (lambda: random_dof().label(IMAGE, DEPTH), "params must be those of 4 images, got none; call it before"),
    (lambda: random_dof().label(IMAGE, DEPTH, random_dof().forward_parameters((3, 3, 18, 24))), "got those of 3"),
    (lambda: random_dof()({"image": IMAGE}), "a dict must have 'image' and 'depth', got the keys image"),
    (lambda: random_dof()(IMAGE, DEPTH[:3, 0]), r"depth must be \[4, 1, 18, 24\].* got \[1, 3, 18, 24\]"),
    (lambda: random_dof()((IMAGE - 0.5) / 0.2, DEPTH), r"must lie in \[0, 1\].*.*normalize after"),
)  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("as_dict", [False, True])
def test_depth_beside_images_of_half_precision_is_not_rounded(dtype: torch.dtype, as_dict: bool) -> None:
    image, depth = sample()
    depth[..., :4] = 1e5  # more than the largest float16
    seq = DepthAugmentationSequential(
        K.RandomHorizontalFlip(p=1.0), random_dof(), data_keys=None if as_dict else ["input", "mask"]
    )
    if as_dict:
        out = seq({"input": image.to(dtype), "mask": depth, "name": "a"})
        assert out["name"] == "a"
        blurred, moved = out["input"], out["mask"]
    else:
        blurred, moved = seq(image.to(dtype), depth)
        inverse = seq.inverse(blurred, moved)
        assert torch.equal(inverse[1], depth) and inverse[0].dtype == dtype
    assert blurred.dtype == dtype and torch.equal(moved, depth.flip(-1))


@pytest.mark.parametrize("p", [0.5, 1.0])
def test_an_empty_batch_passes_as_through_kornias_own_steps(p: float) -> None:
    image, depth = sample(0)
    aug = random_dof(p=p)
    for given in ((image, depth), (image, torch.ones(1, 1, 18, 24)), (torch.cat([image, depth], 1),)):
        assert aug(*given).shape == given[0].shape
    assert aug({"image": image, "depth": depth})["image"].shape == image.shape
    out = DepthAugmentationSequential(K.RandomHorizontalFlip(), aug, data_keys=["input", "mask"])(image, depth)
    assert [t.shape for t in out] == [image.shape, depth.shape]
    label = aug.label(image, depth)
    assert label["coc_px"].shape == depth.shape and label["focus_m"].shape == (0,)
    with pytest.raises(ValueError, match="depth must be"):
        aug(image, torch.rand(0, 1, 18, 23))


def test_a_matte_goes_with_the_depth_and_decides_the_coverage() -> None:
    image, depth = torch.rand(2, 3, 32, 48), torch.full((2, 1, 32, 48), 6.0)
    depth[..., :20] = 1.0
    matte = torch.zeros(2, 1, 32, 48)
    matte[..., :22], matte[..., 22] = 1.0, 0.5
    aug = RandomDepthOfField((6.0, 6.0), (1.0, 1.0), CAMERA, transfer="linear", p=1.0)
    plain, matted = aug(image, depth), aug(image, depth, matte=matte)
    camera = CAMERA.replace(focus_m=6.0, f_number=1.0)
    assert not torch.equal(plain, matted) and "matte" not in aug._params
    assert_close(matted, depth_of_field(image, depth, camera, matte=matte, check=False))
    assert torch.equal(aug(image, depth, matte=matte[:, 0]), matted)
    assert torch.equal(aug({"image": image, "depth": depth, "matte": matte})["image"], matted)
    masks = ["input", "mask", "mask", "mask"]
    turned = DepthAugmentationSequential(K.RandomHorizontalFlip(p=1.0), aug, data_keys=masks, matte_mask=2)
    flipped, _, _, cover = turned(image.flip(-1), depth.flip(-1), torch.ones_like(depth), matte.flip(-1))
    assert torch.equal(flipped, matted) and torch.equal(cover, matte)
    few = DepthAugmentationSequential(aug, data_keys=["input", "mask"], matte_mask=1)
    with pytest.raises(ValueError, match="matte_mask is 1, but there are 1 masks"):
        few(image, depth)
    with pytest.raises(ValueError, match="matte must"):
        aug(image, depth, matte=matte[..., 1:])
