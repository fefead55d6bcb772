"""Copies of a recording as other programs make them, with the ``mcap`` package's reader and writer.

``copy`` follows the rewriting commands of the ``mcap`` command-line tool (filter, sort, merge, compress): messages
come in order of their log time, schemas and channels are written before their first message, and merging numbers
the channels anew.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

Order = Literal["file", "time", "shuffled", "reversed"]


def copy(
    sources: Sequence[Path],
    out: Path,
    *,
    chunk_bytes: int = 1 << 20,
    compression: CompressionType = CompressionType.ZSTD,
    order: Order = "time",
    topics: tuple[str, ...] = ("ticks", "events"),
    metadata: Literal["first", "last", "none"] = "first",
    chunked: bool = True,
    crcs: bool = True,
    from_ns: int = 0,
) -> Path:
    """Write the messages of ``sources`` into ``out``."""
    messages: list[tuple[Schema, Channel, Message]] = []
    texts: list[Metadata] = []
    for source in sources:
        with source.open("rb") as file:
            reader = NonSeekingReader(file)
            messages += [(s, c, m) for s, c, m in reader.iter_messages(log_time_order=False) if s is not None]
            file.seek(0)
            texts += list(NonSeekingReader(file).iter_metadata())
    if order == "time":
        messages.sort(key=lambda item: item[2].log_time)
    elif order == "shuffled":
        random.Random(7).shuffle(messages)
    elif order == "reversed":
        messages.reverse()
    with out.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_bytes, compression=compression, use_chunking=chunked, enable_crcs=crcs)
        writer.start(profile="micron")
        if metadata == "first":
            _write_texts(writer, texts)
        channels: dict[str, int] = {}
        for schema, channel, message in messages:
            if channel.topic not in topics or message.log_time < from_ns:
                continue
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(
                channels[channel.topic], message.log_time, message.data, message.publish_time, message.sequence
            )
        if metadata == "last":
            _write_texts(writer, texts)
        writer.finish()
    return out


def _write_texts(writer: Writer, texts: Sequence[Metadata]) -> None:
    seen: list[Metadata] = []
    for text in texts:
        if text not in seen:
            seen.append(text)
            writer.add_metadata(text.name, text.metadata)
