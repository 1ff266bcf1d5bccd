"""Bags that are compressed as a whole, file by file or message by message, and those that would fill the memory."""

import gzip
import os
from contextlib import ExitStack

import pytest
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from bag_samples import DRIVE, FRAMES, assert_same_frames, refused
from bag_writers import file_of, nanoseconds, raw, types, write
from echogrid.bags import unpacking
from echogrid.bags.bag_file import BagFile
from echogrid.errors import InputError
from echogrid.logs.formats import load_log
from echogrid.packed import TooLongError, zstd
from log_samples import peak_of

PLUGINS = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}


pytestmark = pytest.mark.usefixtures("temporary")


def recorded(path, form, mode, drive=DRIVE):
    """A bag as ``ros2 bag record --compression-mode`` writes it."""
    writer = FolderWriter(path, version=8, storage_plugin=PLUGINS[form])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    store, connections = types(ros1=False), {}
    with writer:
        for said in drive:
            if said.topic not in connections:
                connections[said.topic] = writer.add_connection(said.topic, said.type, typestore=store)
            writer.write(connections[said.topic], nanoseconds(said.time), raw(said, store, ros1=False))
    return path


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("form", PLUGINS)
def test_a_compressed_bag_is_read_as_a_folder_and_as_its_file_alone(tmp_path, form, mode):
    path = recorded(tmp_path / "drive", form, mode)
    for bag in (path, file_of(path)):
        log = load_log(bag)
        assert_same_frames(log, FRAMES)
        assert_same_frames(log, FRAMES)
        assert log.notes == {}
        assert log.name == str(bag)


@pytest.mark.parametrize("form", ["bag", "mcap", "sqlite3"])
def test_a_bag_that_somebody_compressed_is_read(tmp_path, form):
    name = tmp_path / ("drive.bag" if form == "bag" else "drive")
    plain = file_of(write(name, DRIVE, form))
    for kind, pack in {"gz": gzip.compress, "zst": zstd.compress}.items():
        path = tmp_path / f"{plain.name}.{kind}"
        path.write_bytes(pack(plain.read_bytes()))
        assert_same_frames(load_log(path), FRAMES)


def test_nothing_is_left_of_a_bag_while_it_is_read_and_when_reading_stops(tmp_path, temporary):
    path = file_of(recorded(tmp_path / "drive", "mcap", CompressionMode.FILE))
    frames = iter(load_log(path))
    next(frames)
    assert list(temporary.rglob("*")) == []
    del frames
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    with pytest.raises(InputError, match="cut off or damaged"):
        load_log(path)


def test_a_folder_with_a_pipe_in_it_is_refused(tmp_path):
    path = write(tmp_path / "drive", DRIVE, "mcap")
    file = file_of(path)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(InputError, match="not a plain file"):
        load_log(path)


def mcap_bomb(path, length, compression):
    """A bag with a chunk that becomes far longer than it is."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=2**40)
        writer.start(profile="ros2")
        text = types(ros1=False).generate_msgdef("sensor_msgs/msg/Range", ros_version=2)[0]
        schema = writer.register_schema("sensor_msgs/msg/Range", "ros2msg", text.encode())
        channel = writer.register_channel("/sonar", "cdr", schema)
        writer.add_message(channel, 0, bytes(length), 0)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_that_becomes_far_longer_is_refused_in_little_memory(tmp_path, compression, capsys):
    path = mcap_bomb(tmp_path / "drive.mcap", 2**28, compression)
    assert path.stat().st_size < 2**21
    assert peak_of(lambda: refused(capsys, path)) < 2**26
    assert "a chunk of" in refused(capsys, path)
    assert "does not grow so much" in refused(capsys, path)


def test_a_chunk_that_says_too_little_of_itself_is_refused_in_little_memory():
    bomb = zstd.compress(bytes(2**27))

    def unpack():
        with pytest.raises(TooLongError):
            unpacking.storage_mcap.DECOMPRESSORS["zstd"](bomb, 99)

    assert peak_of(unpack) < 2**22
    assert unpacking.storage_mcap.DECOMPRESSORS["zstd"](zstd.compress(b"abc"), 3) == b"abc"


def test_the_library_unpacks_its_chunks_by_the_table_that_is_bounded(tmp_path, monkeypatch):
    packed = mcap_bomb(tmp_path / "small.mcap", 100, CompressionType.ZSTD)
    asked = []
    table = unpacking.storage_mcap.DECOMPRESSORS
    monkeypatch.setitem(table, "zstd", lambda data, size, old=table["zstd"]: asked.append(size) or old(data, size))
    with BagFile(packed) as bag:
        reader = bag._reader.messages(bag._connections)
        assert [len(data) for _, _, data in reader] == [100]
    assert len(asked) == 1


@pytest.mark.parametrize("form", [BagWriter.CompressionFormat.BZ2, BagWriter.CompressionFormat.LZ4])
def test_a_chunk_of_ros1_that_becomes_far_longer_is_refused_in_little_memory(tmp_path, form):
    path = tmp_path / "drive.bag"
    writer = BagWriter(path)
    writer.set_compression(form)
    with writer:
        connection = writer.add_connection("/sonar", "sensor_msgs/msg/Range", typestore=types(ros1=True))
        writer.write(connection, 10**9, bytes(2**28))
    assert path.stat().st_size < 2**21

    def read():
        with BagFile(path) as bag, pytest.raises(InputError, match="becomes more than"):
            list(bag.messages({"/sonar"}))

    assert peak_of(read) < 2**29


def test_a_message_that_becomes_far_longer_is_refused_in_little_memory(tmp_path):
    path = tmp_path / "drive"
    writer = FolderWriter(path, version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/sonar", "sensor_msgs/msg/Range", typestore=types(ros1=False))
        writer.write(connection, 10**9, bytes(2**28))

    def read():
        for each in (path, file_of(path)):
            with BagFile(each) as bag, pytest.raises(InputError, match="becomes 268435456"):
                list(bag.messages({"/sonar"}))

    assert peak_of(read) < 2**24


def test_chunks_of_one_time_are_bounded_together(tmp_path, monkeypatch):
    path = file_of(write(tmp_path / "drive", DRIVE, "mcap"))
    with BagFile(path):
        pass
    monkeypatch.setattr(unpacking, "MAX_TOGETHER", 100)
    with pytest.raises(InputError, match="chunks of one time"), BagFile(path):
        pass


def test_metadata_of_anchors_is_refused(tmp_path):
    path = write(tmp_path / "drive", DRIVE, "mcap")
    nested = "\n".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12))
    (path / "metadata.yaml").write_text(f"a0: &a0 [1]\n{nested}\n")
    with pytest.raises(InputError, match="anchors that become more than"):
        load_log(path)


def test_a_bag_that_is_not_compressed_is_read_where_it_lies(tmp_path):
    path = write(tmp_path / "drive", DRIVE, "mcap")
    with ExitStack() as stack:
        assert unpacking.unpacked_bag(path, "", stack) == path
        assert unpacking.unpacked_bag(file_of(path), ".mcap", stack) == file_of(path)
