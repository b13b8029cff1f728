"""The table of streams, the schemas and the documents say the same."""

from __future__ import annotations

import typing
from pathlib import Path

import schemas
from common.messages import Message
from common.streams import STREAMS, Congestion, Radio, Stream
from common.wire import schema_name

DOCUMENT = Path(__file__).parents[1] / "docs" / "streams.md"
HEAD = """# Streams

Written from `common/streams.py` by `python tests/test_streams.py`; a test compares the two.
Keys read `luojia/@v1/{vehicle}/{stream}`; `/…` marks streams that append chunks (a tile's place, a keyframe's index).

| stream | message | schema | rate | priority | when the link is full | radio | at most | stale after |
|---|---|---|---|---|---|---|---|---|
"""


def row(stream: Stream) -> str:
    schema = schema_name(stream.message)
    cells = (
        f"`{stream.name}{'/…' if stream.keyed else ''}`",
        stream.message.__name__,
        f"[`{schema}`](../schemas/{schema}.json)",
        f"{stream.rate_hz:g} Hz" if stream.rate_hz else "on change",
        stream.priority.name.lower().replace("_", " ") + (", express" if stream.express else ""),
        {Congestion.DROP: "dropped", Congestion.BLOCK: "sender waits"}[stream.congestion],
        {Radio.BOTH: "data + video", Radio.VIDEO: "video", Radio.LOCAL: "none"}[stream.radio],
        f"{stream.max_bytes:,} B".replace(",", " "),
        f"{stream.stale_after_s:g} s" if stream.stale_after_s else "never",
    )
    return f"| {' | '.join(cells)} |\n"


def document() -> str:
    return HEAD + "".join(map(row, STREAMS))


def test_the_document_is_the_table() -> None:
    assert DOCUMENT.read_text(encoding="utf-8") == document()


def test_every_message_has_a_stream_and_a_schema_and_no_schema_is_left_over() -> None:
    messages = set(typing.get_args(Message))
    assert {stream.message for stream in STREAMS} == messages
    assert sorted(schema_name(message) for message in messages) == schemas.names()


def test_no_stream_hides_another() -> None:
    names = [stream.name for stream in STREAMS]
    assert len(set(names)) == len(names)
    for keyed in (stream for stream in STREAMS if stream.keyed):
        assert not any(name.startswith(keyed.name + "/") for name in names)


def test_nothing_is_larger_than_a_dropping_link_carries() -> None:
    """Zenoh loses dropped messages over about 2 MB even on an idle link; what goes by radio is 256 kB at most."""
    assert max(stream.max_bytes for stream in STREAMS if stream.radio is not Radio.LOCAL) <= 256_000


if __name__ == "__main__":
    DOCUMENT.write_text(document(), encoding="utf-8")
