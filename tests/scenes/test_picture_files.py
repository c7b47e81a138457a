"""Pictures: all bits of every kind of file, the right way up, one picture, as values from 0 to 255, and losses said."""

from __future__ import annotations

import os
import struct
import tracemalloc
import zlib
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import imagecodecs
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from skimage import data, io

from ommatid.runtime.errors import InputError
from ommatid.scenes.formats.picture import LUMINANCE, conversions, load, luminance, write_truth
from ommatid.scenes.formats.picture_file import read_picture
from ommatid.scenes.formats.stored_picture import StoredPicture
from ommatid.scenes.scene import Scene, with_changes

from ..examples import scene
from ..fuzz.verdicts import PeakMemory
from . import picture_bytes as made


def looking_at(path: Path, **target: object) -> Scene:
    plain = scene().plain()
    plain["target"] = {"image": path.name, "pixel_pitch": "1 mm", "distance": "1 m", **target}
    return with_changes(plain, path.with_name("scene.toml"), (), ())


def save(path: Path, pixels: NDArray[Any]) -> Path:
    if path.suffix == ".npy":
        np.save(path, pixels)
    elif path.suffix == ".exr":
        write_truth(path, pixels)
    else:
        save_image: Any = io.imsave  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        save_image(path, pixels, check_contrast=False)
    return path


GREY = np.arange(20 * 30, dtype=np.uint8).reshape(20, 30)


@pytest.mark.parametrize(
    ("name", "pixels", "expected"),
    [
        ("grey.png", GREY, GREY),
        ("deep.png", GREY.astype(np.uint16) * 257, GREY),
        ("float.tiff", GREY.astype(np.float32) / 7, GREY / np.float32(7)),
        ("signed.npy", GREY - 300.25, GREY - 300.25),
        ("grey.exr", GREY * 0.5, GREY * 0.5),
        ("bool.npy", GREY > 100, (GREY > 100) * 255.0),
    ],
)
def test_every_format_gives_the_same_values(
    tmp_path: Path, name: str, pixels: NDArray[Any], expected: NDArray[Any]
) -> None:
    image = load(looking_at(save(tmp_path / name, pixels)))
    assert image.dtype == np.float64
    np.testing.assert_array_equal(image, expected)


def test_colour_becomes_luminance() -> None:
    assert sum(LUMINANCE) == pytest.approx(1, abs=1e-12)
    colour: Any = data.astronaut()
    from skimage.color import rgb2gray

    reference: NDArray[np.float64] = np.asarray(rgb2gray(colour)) * 255  # pyright: ignore
    np.testing.assert_allclose(luminance(StoredPicture(colour), "here"), reference, atol=1e-10)
    opaque = np.dstack([colour, np.full(colour.shape[:2], 255, np.uint8)])
    np.testing.assert_allclose(luminance(StoredPicture(opaque), "here"), reference, atol=1e-10)
    opaque[0, 0, 3] = 7
    with pytest.raises(InputError, match="transparent"):
        luminance(StoredPicture(opaque), "here")
    for alpha in (0, 128):  # evenly transparent
        with pytest.raises(InputError, match="transparent"):
            luminance(StoredPicture(np.dstack([colour, np.full(colour.shape[:2], alpha, np.uint8)])), "here")


def test_crops_follow_origin_and_shape(tmp_path: Path) -> None:
    path = save(tmp_path / "grey.png", GREY)
    np.testing.assert_array_equal(load(looking_at(path, origin=[3, 5], shape=[10, 12])), GREY[3:13, 5:17])
    np.testing.assert_array_equal(load(looking_at(path, origin=[3, 5])), GREY[3:, 5:])


@pytest.mark.parametrize("target", [{"origin": [15, 0], "shape": [10, 10]}, {"origin": [20, 0]}, {"shape": [19, 30]}])
def test_crops_outside_the_picture_are_refused(tmp_path: Path, target: dict[str, object]) -> None:
    path = save(tmp_path / "grey.png", GREY)
    with pytest.raises(InputError, match=r"20 x 30"):
        load(looking_at(path, **target))


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        *((bad, "holds NaN or infinite values") for bad in (np.nan, np.inf, 1e39)),
        *((bad, r"expected values up to 1e\+12 in .*a.npy, got one of size") for bad in (3e38, -3e38, 1.1e12)),
    ],
)
def test_values_that_files_cannot_hold_are_refused_only_inside_the_crop(tmp_path: Path, bad: float, words: str) -> None:
    pixels = GREY.astype(np.float64)
    pixels[0, 0] = bad
    path = save(tmp_path / "a.npy", pixels)
    for read in (load, conversions):
        with pytest.raises(InputError, match=words):
            read(looking_at(path))
    np.testing.assert_array_equal(load(looking_at(path, origin=[1, 1])), GREY[1:, 1:])


@pytest.mark.parametrize(
    ("name", "mode", "words"),
    [
        ("a.tif", "P", "the kind PALETTE"),
        ("a.tif", "CMYK", "the kind SEPARATED"),
        ("a.jpg", "CMYK", r"inks \(CMYK\)"),
        ("white.tif", "L", "the kind MINISWHITE"),
    ],
)
def test_values_that_are_not_light_are_refused(name: str, mode: str, words: str, tmp_path: Path) -> None:
    from PIL import Image

    colour = Image.fromarray(np.dstack([GREY, GREY[::-1], GREY[:, ::-1]]))
    options: dict[str, Any] = (
        {"tiffinfo": {262: 0}} if name == "white.tif" else {}
    )  # photometric interpretation: 0 is white
    colour.convert(mode).save(tmp_path / name, **options)
    with pytest.raises(InputError, match=f"{name}: expected grey or RGB, got .*{words}"):
        load(looking_at(tmp_path / name))


RNG = np.random.default_rng(19)
WRITE_TIFF: Any = cast(Any, tifffile).imwrite
# A letter F: no turning or mirroring leaves it as it is.
LETTER = np.zeros((24, 16), np.uint8)
LETTER[2:22, 3:6] = LETTER[2:5, 3:13] = LETTER[10:13, 3:10] = 200


def pixels_in(path: Path, content: bytes) -> NDArray[Any]:
    path.write_bytes(content)
    return read_picture(path, "here").pixels


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as refused:
        read_picture(path, "here")
    assert len(str(refused.value)) < 300
    return str(refused.value)


def sentences(path: Path) -> str:
    return "\n".join(conversions(looking_at(path)))


@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize(("colour", "bits"), made.KINDS)
def test_every_png_keeps_its_numbers(colour: int, bits: int, interlaced: bool, tmp_path: Path) -> None:
    samples = RNG.integers(0, 2**bits, (11, 13, made.SAMPLES[colour]))
    decoded = pixels_in(tmp_path / "a.png", made.png(samples, colour, bits, interlaced=interlaced))
    assert decoded.dtype == (np.uint16 if bits == 16 else np.uint8)
    np.testing.assert_array_equal(decoded.reshape(samples.shape), samples)


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_a_palette_is_looked_up(bits: int, tmp_path: Path) -> None:
    indices = RNG.integers(0, 2**bits, (9, 17))
    table = RNG.integers(0, 256, (2**bits, 3)).astype(np.uint8)
    path = tmp_path / "a.png"
    decoded = pixels_in(path, made.png(indices, 3, bits, made.chunk(b"PLTE", table.tobytes())))
    np.testing.assert_array_equal(decoded, table[indices])
    assert "a.png has a palette: its colours are looked up" in sentences(path)
    lacking = made.png(indices, 3, bits, made.chunk(b"PLTE", table[: indices.max()].tobytes()))
    with pytest.raises(InputError, match="it has colours that its palette lacks"):
        pixels_in(path, lacking)


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_the_largest_value_of_a_target_is_white(bits: int, tmp_path: Path) -> None:
    samples = np.arange(20 * 20).reshape(20, 20) % 2**bits
    samples[0, 0] = 2**bits - 1
    (tmp_path / "a.png").write_bytes(made.png(samples, 0, bits))
    np.testing.assert_allclose(load(looking_at(tmp_path / "a.png")), samples * 255 / (2**bits - 1), rtol=1e-7)
    assert (f"has {bits}-bit values" in sentences(tmp_path / "a.png")) == (bits != 8)


def turned(orientation: int) -> NDArray[np.uint8]:
    """The letter as a camera stores it which notes this orientation: the inverse of what the tag asks for."""
    stored = {  # where row 0 and column 0 of the stored picture lie in the upright one
        **{1: LETTER, 2: np.fliplr(LETTER), 3: np.rot90(LETTER, 2), 4: np.flipud(LETTER), 5: LETTER.T},
        **{6: np.rot90(LETTER), 7: np.rot90(LETTER.T, 2), 8: np.rot90(LETTER, -1)},
    }
    return np.ascontiguousarray(stored[orientation])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_upright(orientation: int, tmp_path: Path) -> None:
    stored, order = turned(orientation), "<>"[orientation % 2]
    chunk = made.chunk(b"eXIf", made.exif(orientation, order))
    (tmp_path / "a.png").write_bytes(made.png(stored, 0, 8, chunk))
    (tmp_path / "late.png").write_bytes(made.png(stored, 0, 8, after=chunk))
    (tmp_path / "a.jpg").write_bytes(made.jpeg(stored, exif=b"Exif\0\0" + made.exif(orientation, order)))
    for name, planar in (("a.tif", stored), ("colour.tif", np.dstack([stored] * 3))):
        kind = "rgb" if planar.ndim == 3 else "minisblack"
        WRITE_TIFF(tmp_path / name, planar, photometric=kind, extratags=[(274, 3, 1, orientation, True)])
    for path in sorted(tmp_path.iterdir()):
        found = read_picture(path, "here").pixels
        difference = np.abs((found if found.ndim == 2 else found[..., 1]).astype(int) - LETTER)
        assert difference.max() <= (8 if path.suffix == ".jpg" else 0), path.name  # JPEG rounds
        assert (f"orientation {orientation} of EXIF" in sentences(path)) == (orientation > 1)
    reference = Image.fromarray(stored)
    reference.getexif()[274] = orientation
    from PIL import ImageOps

    np.testing.assert_array_equal(np.asarray(ImageOps.exif_transpose(reference)), LETTER)


def animated(frames: int) -> bytes:
    control = struct.pack(">IIIIIHHBB", 0, 8, 8, 0, 0, 1, 1, 0, 0)
    more = b"".join(made.chunk(b"fcTL", control) for _ in range(frames))
    return made.png(np.zeros((8, 8)), 0, 8, made.chunk(b"acTL", struct.pack(">II", frames, 0)), more)


def test_files_of_several_pictures_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(animated(7))
    assert "expected one picture, got several frames" in refusal(tmp_path / "a.png")
    assert pixels_in(tmp_path / "still.png", animated(1)).shape == (8, 8)
    for count in (2, 3, 4):  # three and four pages are not the colours of one
        WRITE_TIFF(tmp_path / "a.tif", np.zeros((count, 9, 9), np.uint8), photometric="minisblack")
        assert "expected one picture, got several" in refusal(tmp_path / "a.tif")
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        for size in (8, 12):
            cast(Any, file).write(np.zeros((size, size), np.uint8), photometric="minisblack", metadata=None)
    assert "got several" in refusal(tmp_path / "b.tif")
    one, two = (Image.fromarray(np.full((16, 16), value, np.uint8)) for value in (9, 90))
    one.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[two, two])
    assert "expected one picture, got several pictures" in refusal(tmp_path / "a.jpg")


def test_a_reduced_copy_of_a_page_is_no_other_page(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        cast(Any, file).write(LETTER, photometric="minisblack", metadata=None)
        cast(Any, file).write(LETTER[::2, ::2], photometric="minisblack", metadata=None, subfiletype=1)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif", "here").pixels, LETTER)


@pytest.mark.parametrize(
    ("colour", "bits", "chunks"),
    [
        (0, 8, made.chunk(b"tRNS", b"\0\5")),
        (0, 2, made.chunk(b"tRNS", b"\0\1")),
        (0, 16, made.chunk(b"tRNS", b"\0\5")),
        (2, 8, made.chunk(b"tRNS", b"\0\5\0\5\0\5")),
        (3, 8, made.chunk(b"PLTE", bytes(range(90))) + made.chunk(b"tRNS", b"\xff\xff\xff\xff\xff\x80")),
    ],
)
def test_colours_that_are_transparent_are_refused_where_they_are_used(
    colour: int, bits: int, chunks: bytes, tmp_path: Path
) -> None:
    path, samples = tmp_path / "a.png", np.full((8, 8, made.SAMPLES[colour]), 3)
    path.write_bytes(made.png(samples, colour, bits, chunks))
    load(looking_at(path))  # the transparent colour does not occur
    samples[2, 2] = 1 if bits == 2 else 5
    path.write_bytes(made.png(samples, colour, bits, chunks))
    with pytest.raises(InputError, match="partly transparent"):
        load(looking_at(path))


@pytest.mark.parametrize("name", [b"zTXt", b"iTXt", b"iCCP"])
def test_texts_and_profiles_are_inflated_up_to_a_limit(name: bytes, tmp_path: Path) -> None:
    before = b"x\0\1\0\0\0" if name == b"iTXt" else b"x\0\0"
    for length, fits in ((10_000, True), (30_000_000, False)):
        content = made.png(LETTER, 0, 8, made.chunk(name, before + zlib.compress(bytes(length), 9)))
        tracemalloc.start()
        if fits:
            np.testing.assert_array_equal(pixels_in(tmp_path / "a.png", content), LETTER)
        else:
            (tmp_path / "a.png").write_bytes(content)
            assert "could not be read" in refusal(tmp_path / "a.png")
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
        tracemalloc.stop()


def test_what_libraries_print_of_a_sound_picture_is_not_shown(capfd: pytest.CaptureFixture[str]) -> None:
    load(with_changes(scene().plain(), Path("scene.toml"), ("target.image=photo:page", "target.origin=[0,0]"), ()))
    assert capfd.readouterr() == ("", "")


def write_large_headers(folder: Path) -> None:
    """Write a file of each format whose header states some 60000 x 60000 pixels, with almost none."""
    (folder / "a.png").write_bytes(made.png_of(made.header(65500, 65500, 2), made.chunk(b"IDAT", bytes(99))))
    small = made.jpeg(LETTER)
    place = small.index(b"\xff\xc0") + 5
    (folder / "a.jpg").write_bytes(small[:place] + struct.pack(">HH", 65500, 65500) + small[place + 4 :])
    WRITE_TIFF(folder / "a.tif", LETTER, photometric="minisblack", compression="zlib")
    described = bytearray((folder / "a.tif").read_bytes())
    with tifffile.TiffFile(folder / "a.tif") as file:
        for tag in (256, 257, 278):  # columns, rows, and rows of a strip
            place = int(cast(Any, file.pages[0]).tags[tag].offset) + 2
            described[place : place + 10] = struct.pack("<HII", 4, 1, 60000)
    (folder / "a.tif").write_bytes(described)
    window, large = (struct.pack("<4i", 0, 0, side, side) for side in (7, 50000))
    (folder / "a.exr").write_bytes(made.exr({"Y": ("<f4", 1, 1)}, (0, 0, 7, 7)).replace(window, large))


def test_sizes_are_refused_from_headers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_large_headers(tmp_path)
    text = b"{'descr': '|u1', 'fortran_order': False, 'shape': (60000, 60000), }\n"
    with (tmp_path / "a.npy").open("wb") as stream:  # which is as long as it states, without using the disk
        stream.write(b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text)
        stream.truncate(3_700_000_000)
    monkeypatch.setattr("ommatid.runtime.machine.free_memory", lambda: 90_000_000)
    for path in sorted(tmp_path.iterdir()):
        assert "GB of memory, 0.09 GB are free" in refusal(path), path.name


def test_a_file_too_short_for_its_header_is_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However much memory there is, its pixels are not decoded."""
    write_large_headers(tmp_path)
    monkeypatch.setattr("ommatid.runtime.machine.free_memory", lambda: 10**15)
    memory = PeakMemory()
    for path in sorted(tmp_path.iterdir()):
        assert "could not be read" in refusal(path) or "cut short" in refusal(path) or "got fewer" in refusal(path)
    assert not memory.excess()


@pytest.mark.parametrize(
    ("compression", "packed"),
    [
        ("tiff_adobe_deflate", zlib.compress(bytes(20_000_000))),
        ("packbits", b"\x81\0" * 50_000),
        ("tiff_lzw", imagecodecs.lzw_encode(bytes(20_000_000))),
    ],
    ids=["deflate", "packbits", "lzw"],
)
def test_a_strip_is_not_inflated_beyond_its_pixels(compression: str, packed: bytes, tmp_path: Path) -> None:
    Image.fromarray(LETTER).save(tmp_path / "a.tif", compression=compression)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif", "here").pixels, LETTER)
    content = bytearray((tmp_path / "a.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        tags = cast(Any, file.pages[0]).tags
        for tag, value in ((273, len(content)), (279, len(packed))):  # place and length of the strip
            content[tags[tag].offset + 2 : tags[tag].offset + 12] = struct.pack("<HII", 4, 1, value)
    (tmp_path / "a.tif").write_bytes(content + packed)
    tracemalloc.start()
    with nullcontext() if compression == "tiff_lzw" else pytest.raises(InputError, match="could not be read"):
        assert read_picture(tmp_path / "a.tif", "here").pixels.shape == LETTER.shape  # LZW ends with the pixels
    assert tracemalloc.get_traced_memory()[1] < 2_000_000
    tracemalloc.stop()


@pytest.mark.parametrize("options", [{"tile": (16, 32)}, {"tile": (16, 32), "compression": "lzw"}, {"rowsperstrip": 5}])
def test_a_missing_strip_or_tile_is_no_black_one(options: dict[str, Any], tmp_path: Path) -> None:
    """tifffile fills it with zeros."""
    path = save_tiff(tmp_path / "a.tif", np.full((37, 53), 99, np.uint8), **options)
    with tifffile.TiffFile(path) as file:
        tag = cast(Any, file.pages[0]).tags["TileByteCounts" if "tile" in options else "StripByteCounts"]
        offset, code = tag.valueoffset, {3: "<H", 4: "<I"}[int(tag.dtype)]
    content = bytearray(path.read_bytes())
    content[offset : offset + struct.calcsize(code)] = struct.pack(code, 0)
    path.write_bytes(content)
    assert "could not be read" in refusal(path)


def save_tiff(path: Path, pixels: NDArray[Any], **options: Any) -> Path:
    WRITE_TIFF(path, pixels, **{"photometric": "minisblack", "metadata": None, **options})
    return path


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "zlib", "predictor": True},
        {"compression": "lzw", "predictor": True},
        {"compression": "lzw", "rowsperstrip": 5},
        {"compression": "zlib", "tile": (16, 16)},
        {"rowsperstrip": 5},
        {"bigtiff": True},
        {"byteorder": ">"},
        {"planarconfig": "separate", "photometric": "rgb"},
        {"photometric": "rgb"},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "f4", "f8"])
def test_every_layout_of_a_tiff_is_the_same_picture(options: dict[str, Any], dtype: str, tmp_path: Path) -> None:
    colours = np.stack([LETTER, LETTER // 2, LETTER // 3], axis=-1).astype(dtype)
    pixels = colours if "photometric" in options else colours[..., 0]
    stored = np.moveaxis(pixels, -1, 0) if "planarconfig" in options else pixels
    decoded = read_picture(save_tiff(tmp_path / "a.tif", stored, **options), "here").pixels
    assert decoded.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(decoded, pixels)


@pytest.mark.parametrize("length", [2, 150])
def test_a_circular_list_of_pages_ends(length: int, tmp_path: Path) -> None:
    """tifffile follows a circle of more than a hundred pages without end."""
    path = save_tiff(tmp_path / "a.tif", np.zeros((length, 16, 16), np.uint8))
    with tifffile.TiffFile(path) as file:
        pages = [cast(Any, page) for page in file.pages]
        last = pages[-1].offset + 2 + 12 * len(pages[-1].tags)
        second = pages[1].offset
    content = bytearray(path.read_bytes())
    content[last : last + 4] = struct.pack("<I", second)
    path.write_bytes(content)
    assert "circular" in refusal(path)


def test_frames_without_pages_are_refused(tmp_path: Path) -> None:
    WRITE_TIFF(tmp_path / "a.tif", np.zeros((5, 16, 16), np.uint8), photometric="minisblack", truncate=True)
    assert "expected a page for every frame" in refusal(tmp_path / "a.tif")
    path = save_tiff(tmp_path / "a.tif", LETTER, description="ImageJ=1.54\nimages=9\nslices=9\n")
    assert "expected a page for every frame" in refusal(path)


GREY_EXR = {"Y": ("<f4", 1, 1)}
WINDOW = (0, 0, 9, 7)


@pytest.mark.parametrize("number", ["<u4", "<f2", "<f4"])
@pytest.mark.parametrize("window", [WINDOW, (-4, 3, 5, 10)])
def test_every_exr_is_the_same_picture(number: str, window: tuple[int, int, int, int], tmp_path: Path) -> None:
    expected = np.tile(np.arange(10), (8, 1))
    for names in ("Y", "RGB"):
        (tmp_path / "a.exr").write_bytes(made.exr(dict.fromkeys(names, (number, 1, 1)), window))
        decoded = read_picture(tmp_path / "a.exr", "here").pixels
        assert decoded.dtype == np.dtype(number)
        np.testing.assert_array_equal(decoded, expected if names == "Y" else np.stack([expected] * 3, axis=-1))


def test_deep_pictures_and_several_parts_are_refused(tmp_path: Path) -> None:
    import OpenEXR

    library: Any = OpenEXR
    pixels = np.zeros((8, 10), np.float32)
    parts = [library.Part({}, {"Y": pixels}, name=name) for name in ("left", "right")]
    library.File(parts).write(str(tmp_path / "a.exr"))
    assert "expected one picture, got several parts" in refusal(tmp_path / "a.exr")
    deep = np.empty((8, 10), object)
    for index in np.ndindex(deep.shape):
        deep[index] = np.ones(2, np.float32)
    library.File({"type": library.deepscanline, "compression": library.ZIPS_COMPRESSION}, {"Y": deep}).write(
        str(tmp_path / "b.exr")
    )
    assert "got a deep picture" in refusal(tmp_path / "b.exr")


def test_luminance_is_read_beside_colour_differences(tmp_path: Path) -> None:
    channels = {"Y": ("<f2", 1, 1), "RY": ("<f2", 2, 2), "BY": ("<f2", 2, 2)}
    (tmp_path / "a.exr").write_bytes(made.exr(channels, WINDOW))
    assert read_picture(tmp_path / "a.exr", "here").pixels.shape == (8, 10)
    assert "a.exr has channels that are not used: BY, RY" in sentences(tmp_path / "a.exr")


def test_alpha_of_an_exr_counts(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(made.exr({**GREY_EXR, "A": ("<f4", 1, 1)}, WINDOW))
    with pytest.raises(InputError, match="partly transparent"):
        load(looking_at(tmp_path / "a.exr"))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr", ".npy"])
def test_only_regular_files_are_opened(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    os.mkfifo(path)
    with pytest.raises(InputError, match="expected a regular file, got a FIFO"):
        load(looking_at(path))
    path.unlink()
    path.mkdir()
    assert "expected a regular file, got a folder" in refusal(path)
    path.rmdir()
    path.symlink_to("/dev/zero")
    assert "expected a regular file, got a device" in refusal(path)
    path.unlink()
    path.symlink_to(path.name)
    with pytest.raises(InputError, match="could not be read as a picture"):
        load(looking_at(path))
