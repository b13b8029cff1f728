"""A recording gives back what was put in, byte for byte, as far as its file is whole."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from recording_samples import START_NS, STEP_NS, flight, write

from common.errors import SourceError
from common.recording.reader import MAX_PROBLEMS, Recorded, Recording

FLIGHT = flight(100)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "flight.mcap"
    write(path, FLIGHT)
    return path


def read(path: Path) -> tuple[list[Recorded], list[str]]:
    recording = Recording(path)
    messages = list(recording.messages())
    problems = list(recording.problems)
    recording.close()
    return messages, problems


def read_bytes(folder: Path, data: bytes) -> tuple[list[Recorded], list[str]]:
    path = folder / "damaged.mcap"
    path.write_bytes(data)
    return read(path)


def test_a_recording_gives_back_every_byte_in_order(file: Path) -> None:
    recording = Recording(file)
    assert list(recording.messages()) == FLIGHT
    assert list(recording.messages()) == FLIGHT, "a second pass"
    assert (recording.problems, recording.whole, recording.about) == ([], True, {"vehicle": "uav1"})
    assert (recording.first_ns, recording.last_ns) == (FLIGHT[0].log_ns, FLIGHT[-1].log_ns)


def test_any_mcap_reader_finds_named_channels_with_schemas_and_readable_json(file: Path) -> None:
    """The library's own reader with the index, as Foxglove would: JSON channels fit the schema beside them."""
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) == -(-len(FLIGHT) // 20)
        stored = [m.data for _, channel, m in reader.iter_messages() if channel.message_encoding == "msgpack"]
        assert stored == [message.payload for message in FLIGHT]
        seen = set()
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert schema.encoding == "jsonschema"
            if channel.message_encoding == "json":
                jsonschema.validate(json.loads(message.data), json.loads(schema.data))
                seen.add(channel.topic)
    assert {"/uav1/raw/imu", "/uav1/raw/gnss", "/uav1/pose", "/uav1/health/uplink", "/uav1/vehicle"} <= seen


@settings(max_examples=60, deadline=None)
@given(st.integers(-5, 130), st.integers(-5, 130))
def test_seeking_gives_the_messages_of_a_passage(file: Path, first: int, last: int) -> None:
    start, end = START_NS + first * STEP_NS, START_NS + last * STEP_NS
    recording = Recording(file)
    assert list(recording.messages(start, end)) == [m for m in FLIGHT if start <= m.log_ns < end]
    assert recording.problems == []


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_file_cut_anywhere_is_read_up_to_the_cut(file: Path, tmp_path: Path, data: st.DataObject) -> None:
    whole = file.read_bytes()
    cut = data.draw(st.integers(len(b"\x89MCAP0\r\n"), len(whole) - 1))
    chunks = [chunk for chunk in Recording(file).chunks if chunk.offset + chunk.length <= cut]
    messages, problems = read_bytes(tmp_path, whole[:cut])
    assert messages == FLIGHT[: 20 * len(chunks)]
    # The magic behind the footer holds nothing.
    assert cut >= len(whole) - 8 or any("ends without its index" in problem for problem in problems)


def test_a_cut_file_can_still_be_searched_by_time(file: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(file.read_bytes()[: Recording(file).chunks[4].offset + 10])
    recording = Recording(path)
    start = FLIGHT[50].log_ns
    assert list(recording.messages(start)) == FLIGHT[50:80]


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_bits_cost_at_most_their_chunk_and_are_told(file: Path, tmp_path: Path, data: st.DataObject) -> None:
    chunks = Recording(file).chunks
    hit = data.draw(st.sampled_from(chunks))
    damaged = bytearray(file.read_bytes())
    # From the first byte of the chunk's record to its last.
    at = hit.offset - 9 + data.draw(st.integers(0, hit.length + 8) | st.integers(0, 52))
    damaged[at] ^= 1 << data.draw(st.integers(0, 7))
    messages, problems = read_bytes(tmp_path, bytes(damaged))
    number = chunks.index(hit)
    assert [m for m in messages if m in FLIGHT] == messages, "damage never passes for a message"
    untouched = FLIGHT[: 20 * number] + FLIGHT[20 * (number + 1) :]
    assert [m for m in messages if m in untouched] == untouched
    assert problems or messages == FLIGHT, "what the checksum does not cover can change without harm"


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_bytes_raise_anything_but_source_errors(file: Path, tmp_path: Path, data: st.DataObject) -> None:
    junk = bytearray(data.draw(st.binary(max_size=200)))
    kind = data.draw(st.sampled_from(["junk", "magic and junk", "spliced", "twice"]))
    whole = file.read_bytes()
    if kind == "magic and junk":
        junk = bytearray(whole[:8]) + junk
    elif kind == "spliced":
        at, length = data.draw(st.integers(8, len(whole))), data.draw(st.integers(0, 2000))
        junk = bytearray(whole[:at] + junk + whole[at + length :])
    elif kind == "twice":
        junk = bytearray(whole + whole)
    try:
        messages, problems = read_bytes(tmp_path, bytes(junk))
    except SourceError:
        assert junk[:8] != whole[:8]
        return
    assert len(problems) <= MAX_PROBLEMS
    assert all(message in FLIGHT for message in messages)


def test_messages_that_a_lost_chunk_held_are_counted(file: Path, tmp_path: Path) -> None:
    damaged = bytearray(file.read_bytes())
    lost = Recording(file).chunks[3]
    damaged[lost.offset + 100] ^= 1
    _, problems = read_bytes(tmp_path, bytes(damaged))
    lost_imu = sum(m.key.endswith("raw/imu") for m in FLIGHT[60:80])
    assert any(f"{lost_imu} messages of luojia/@v1/uav1/raw/imu before" in problem for problem in problems)


@pytest.mark.parametrize(("content", "named"), [(None, "No such file"), (b"", "empty"), (b"RIFF" * 9, "no MCAP")])
def test_what_is_no_recording_is_refused_in_one_line(content: bytes | None, named: str, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SourceError, match=rf"x\.mcap: .*{named}"):
        Recording(path)
