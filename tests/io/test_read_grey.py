"""Masks as segmentation tools write them: which pixels are the person, or one line that says what is not clear."""

import numpy as np
import pytest
from PIL import Image

from humangs_jax.io.images import oriented, read_grey
from humangs_jax.io.reading import FileError

PERSON = np.zeros((12, 8), bool)
PERSON[2:10, 2:5] = True
VOC = [0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0, 0, 0, 128, 128, 0, 128, 0, 128, 128, 128, 128, 128]


def palette(labels, colors, **options):
    image = Image.new("P", labels.shape[::-1])
    image.putdata(labels.astype(np.uint8).ravel().tolist())
    image.putpalette(colors)
    return image, options


def pixels(array, **options):
    return Image.fromarray(array), options


def grey(mask):
    return np.where(mask, 255, 0).astype(np.uint8)


def colored(mask, person, background=(0, 0, 0)):
    return np.where(mask[..., None], np.uint8(person), np.uint8(background))


PHOTO = np.random.default_rng(0).integers(0, 255, (*PERSON.shape, 3), np.uint8)
RAMP = [value for value in range(256) for _ in range(3)]
READ = {
    "grey": pixels(grey(PERSON)),
    "1 bit": (Image.fromarray(PERSON), {}),
    "16 bits": pixels(np.where(PERSON, 65535, 0).astype(np.uint16)),
    "one label": palette(PERSON * 1, VOC),
    "another label": palette(PERSON * 3, VOC),
    "a label that is grey": palette(PERSON * 7, VOC),
    "labels on a ramp of greys": palette(PERSON * 1, RAMP),
    "a white palette": palette(PERSON * 1, [0, 0, 0, 255, 255, 255]),
    "no label 0": palette(np.where(PERSON, 3, 2), [0, 0, 255, 0, 255, 0, 0, 0, 0, 128, 0, 0]),
    "fewer colors than labels": palette(PERSON * 1, [0, 0, 0]),
    "an opaque palette": palette(PERSON * 1, VOC, transparency=bytes([255, 255])),
    "a transparent background": palette(PERSON * 1, VOC, transparency=0),
    "red": pixels(colored(PERSON, (255, 0, 0))),
    "a cut-out": pixels(np.dstack([PHOTO, grey(PERSON)])),
    "white with alpha": pixels(np.dstack([np.full_like(PHOTO, 255), grey(PERSON)])),
    "black with alpha": pixels(np.dstack([np.zeros_like(PHOTO), grey(PERSON)])),
    "greys equal to alpha": pixels(np.dstack([grey(PERSON), grey(PERSON)])),
    "opaque alpha": pixels(np.dstack([grey(PERSON), np.full_like(grey(PERSON), 255)])),
}


@pytest.mark.parametrize("kind", READ)
def test_the_person_is_read(kind, tmp_path):
    image, options = READ[kind]
    image.save(tmp_path / "mask.png", **options)
    np.testing.assert_array_equal(read_grey(tmp_path / "mask.png"), PERSON)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (palette(0 * PERSON, VOC), 0),
        (palette(1 + 0 * PERSON, VOC), 1),
        (pixels(colored(0 * PERSON, (9, 0, 0))), 0),
        (pixels(np.zeros((*PERSON.shape, 4), np.uint8)), 0),
    ],
)
def test_nobody_and_everything(image, expected, tmp_path):
    image[0].save(tmp_path / "mask.png")
    assert (read_grey(tmp_path / "mask.png") == expected).all()


def test_soft_masks_keep_their_greys(tmp_path):
    soft = np.linspace(0, 255, 96).reshape(12, 8).astype(np.uint8)
    for image, _ in (
        pixels(soft),
        palette(soft, RAMP),
        pixels(np.dstack([PHOTO, soft])),
        pixels(np.dstack([soft] * 3)),
    ):
        image.save(tmp_path / "mask.png")
        np.testing.assert_allclose(read_grey(tmp_path / "mask.png"), soft / 255, atol=1e-6)


TWO = PERSON * 1 + (np.arange(8) > 3) * PERSON
REFUSED = {
    "a palette of the labels 1, 2: which is the person": palette(TWO, VOC),
    "a palette of the labels 0, 1: 0 is not black: which is the background": palette(
        PERSON * 1, [9, 9, 200, 200, 9, 9]
    ),
    "labels 0, 1: 0 is not black": palette(PERSON * 1, [255, 255, 255, 0, 0, 0]),
    "2 colors: which is the person": pixels(colored(TWO == 1, (255, 0, 0)) + colored(TWO == 2, (0, 255, 0))),
    "2 colors without black: which": pixels(colored(PERSON, (255, 0, 0), (0, 0, 200))),
    "an alpha channel besides its greys": pixels(np.dstack([grey(TWO == 1), grey(PERSON)])),
}


@pytest.mark.parametrize("problem", REFUSED)
def test_what_is_not_clear_is_one_line(problem, tmp_path):
    image, options = REFUSED[problem]
    image.save(tmp_path / "mask.png", **options)
    with pytest.raises(FileError) as caught:
        read_grey(tmp_path / "mask.png")
    assert str(caught.value).startswith(f"{tmp_path / 'mask.png'}: ") and problem in str(caught.value)


@pytest.mark.parametrize("flag", range(1, 9))
def test_pixels_are_turned_as_pillow_turns_them(flag, tmp_path):
    from PIL import ImageOps

    exif = Image.Exif()
    exif[0x0112] = flag
    Image.fromarray(PHOTO).save(tmp_path / "photo.png", exif=exif)
    with Image.open(tmp_path / "photo.png") as image:
        np.testing.assert_array_equal(oriented(PHOTO, flag), np.asarray(ImageOps.exif_transpose(image)))
