"""Compressed files are read as what is in them, in bounded memory, and nothing is left of it."""

import bz2
import gzip

import pytest
from lz4.frame import compress as lz4_compress

from echogrid import packed
from echogrid.errors import InputError
from echogrid.packed import TooLongError, opened, unpacked, unpacked_piece, zstd
from log_samples import assert_plain, peak_of, put

PACKERS = {"gzip": gzip.compress, "zstd": zstd.compress, "bzip2": bz2.compress}
PIECES = {"zstd": zstd.compress, "bzip2": bz2.compress, "lz4": lz4_compress}
TEXT = b"".join(b"%d,%d\n" % (n, n * n % 1009) for n in range(5000))


pytestmark = pytest.mark.usefixtures("temporary")


def undeclared(data: bytes) -> bytes:
    """Packed by zstd as it comes, so that it does not say how long it becomes."""
    packer = zstd.ZstdCompressor()
    return packer.compress(data) + packer.flush()


@pytest.mark.parametrize("pack", [bytes, *PACKERS.values(), lambda data: gzip.compress(data) * 2, undeclared])
def test_a_file_is_read_as_what_is_in_it(tmp_path, pack):
    path = put(tmp_path, pack(TEXT))
    whole = TEXT * (2 if path.read_bytes() == gzip.compress(TEXT) * 2 else 1)
    with opened(path) as file:
        assert file.readline() == b"0,0\n"
        assert file.read(10) + file.read() == whole[4:]
    with unpacked(path, "drive.csv") as plain:
        assert (plain.name, plain.read_bytes()) == ("drive.csv", whole)


@pytest.mark.parametrize("kind", PACKERS)
@pytest.mark.parametrize(
    "harm", [lambda data: data[: len(data) // 2], lambda data: data[:-3], lambda data: data[:5] + b"!!!"]
)
def test_what_is_damaged_is_an_input_error(tmp_path, kind, harm):
    path = put(tmp_path, harm(PACKERS[kind](TEXT)))
    with (
        pytest.raises(InputError, match=f"compressed by {kind} that is cut off or damaged") as caught,
        unpacked(path, "drive.csv"),
    ):
        pytest.fail("the block must not run")
    assert_plain(caught.value)


@pytest.mark.parametrize(
    ("content", "tool"),
    [(b"PK\x03\x04" + bytes(99), "unzip"), (lz4_compress(TEXT), "lz4 -d"), (b"7z\xbc\xaf'\x1c", "7z")],
)
def test_what_cannot_be_unpacked_says_what_can(tmp_path, content, tool):
    with (
        pytest.raises(InputError, match=f"compressed by .*, expected the log in it \\({tool}") as caught,
        opened(put(tmp_path, content)),
    ):
        pytest.fail("the block must not run")
    assert_plain(caught.value)


@pytest.mark.parametrize("kind", PACKERS)
def test_a_file_that_becomes_far_longer_is_refused_in_little_memory(tmp_path, kind, monkeypatch):
    monkeypatch.setattr(packed, "SHORT_BAG_BYTES", 2**24)
    path = put(tmp_path, PACKERS[kind](bytes(2**26)))

    def read():
        told = f"compressed by {kind} that becomes more than 16 MB"
        with pytest.raises(InputError, match=told), unpacked(path, "drive.csv"):
            pytest.fail("the block must not run")

    assert peak_of(read) < 2**23
    monkeypatch.setattr(packed, "SHORT_BAG_BYTES", 2**26)
    with unpacked(path, "drive.csv") as plain:
        assert plain.stat().st_size == 2**26


def test_a_disk_without_room_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(packed, "_KEPT_FREE_BYTES", 2**60)
    with (
        pytest.raises(InputError, match=r"too little room in .* expected more .TMPDIR") as caught,
        unpacked(put(tmp_path, gzip.compress(TEXT)), "drive.csv"),
    ):
        pytest.fail("the block must not run")
    assert_plain(caught.value)


@pytest.mark.parametrize("kind", PIECES)
def test_a_piece_becomes_what_it_was_or_is_refused(kind):
    packed_twice = PIECES[kind](TEXT) * 2
    assert unpacked_piece(packed_twice, kind, 2 * len(TEXT)) == TEXT * 2
    with pytest.raises(TooLongError):
        unpacked_piece(packed_twice, kind, 2 * len(TEXT) - 1)
    with pytest.raises((EOFError, OSError, ValueError, RuntimeError)):
        unpacked_piece(packed_twice[:-9], kind, 2 * len(TEXT))
    bomb = PIECES[kind](bytes(2**26))

    def unpack():
        with pytest.raises(TooLongError):
            unpacked_piece(bomb, kind, 2**20)

    assert peak_of(unpack) < 2**23


def test_a_piece_that_hides_how_long_it_becomes_is_refused_all_the_same():
    bomb = undeclared(bytes(2**26))

    def unpack():
        with pytest.raises(TooLongError):
            unpacked_piece(bomb, "zstd", 2**20)

    assert peak_of(unpack) < 2**23
