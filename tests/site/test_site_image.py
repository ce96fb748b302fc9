"""Image sizes, against the images that Pillow writes."""

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from skyless.site.file.check import image_size


def image(form, size, **options):
    out = io.BytesIO()
    Image.new("RGB", size).save(out, form, **options)
    return out.getvalue()


@pytest.mark.parametrize("size", [(1, 1), (640, 480), (300, 5000)])
def test_sizes(size):
    assert image_size(image("PNG", size)) == size
    assert image_size(image("JPEG", size)) == size
    assert image_size(image("JPEG", size, progressive=True, dpi=(72, 72), comment=b"a plan" * 100)) == size


@pytest.mark.parametrize("form", ["GIF", "BMP", "TIFF"])
def test_other_images_are_none(form):
    assert image_size(image(form, (3, 4))) is None


def png(width, height):
    """The first 24 bytes of a PNG, which have its size."""
    return b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big")


def jpeg(width, height, before=b""):
    """A JPEG up to the size in its frame header, which is preceded by other markers."""
    return b"\xff\xd8" + before + b"\xff\xc0\0\x0b\x08" + height.to_bytes(2, "big") + width.to_bytes(2, "big")


@pytest.mark.parametrize("make", [png, jpeg])
def test_exactly_the_bytes_up_to_the_size_are_needed(make):
    data = make(0x1234, 0x567)
    assert image_size(data) == (0x1234, 0x567)
    assert {image_size(data[:length]) for length in range(len(data))} == {None}
    assert image_size(make(0, 1)) is image_size(make(1, 0)) is None


def test_other_chunks_and_markers():
    assert image_size(png(3, 4).replace(b"IHDR", b"IHDX")) is None
    assert image_size(png(2**24, 2**24)) == (2**24, 2**24)
    padding, restart, comment = b"\xff" * 3, b"\xff\xd0\xff\x01", b"\xff\xfe\0\x04ab"
    assert image_size(jpeg(3, 4, padding + restart + comment)) == (3, 4)


@given(st.binary(max_size=200), st.sampled_from([b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b""]))
def test_any_bytes_give_a_size_or_none(tail, head):
    size = image_size(head + tail)
    assert size is None or min(size) > 0
