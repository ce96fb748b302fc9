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


def test_no_size():
    assert image_size(b"") is None
    assert image_size(image("PNG", (3, 4)).replace(b"IHDR", b"IHDX")) is None
    assert image_size(image("PNG", (3, 4))[:16] + bytes(8)) is None


@pytest.mark.parametrize("form", ["PNG", "JPEG"])
def test_cut_off(form):
    data = image(form, (3, 4))
    sizes = {image_size(data[:length]) for length in range(len(data))}
    assert sizes == {None, (3, 4)}


@given(st.binary(max_size=200), st.sampled_from([b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b""]))
def test_any_bytes_give_a_size_or_none(tail, head):
    size = image_size(head + tail)
    assert size is None or min(size) > 0
