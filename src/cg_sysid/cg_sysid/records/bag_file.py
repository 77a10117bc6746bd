"""The bag files that this project writes: rosbag2 MCAP in small chunks, each with its CRC.

The writer of `rosbags` makes the directory and metadata.yaml; the MCAP file is written by the
`mcap` library, which can keep CRCs. With them damage is seen, and with small chunks it costs
little (mcap_scan.py). The numbers of the messages tell how many are missing.
"""

from pathlib import Path

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

CHUNK_BYTES = 64 * 1024


class CheckedMcap:
    """Storage of a bag writer: one MCAP file with CRCs."""

    def __init__(self, path: Path, compression: CompressionMode):
        self.path = path / f'{path.name}.mcap'
        self._file = self.path.open('xb')
        self._writer = McapWriter(
            self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._writer.start('ros2', 'cg_sysid')
        self._schemas: dict[str, int] = {}
        self._channels: dict[int, int] = {}
        self._counts: dict[int, int] = {}

    def add_msgtype(self, connection: Connection) -> None:
        """Write down a message type."""
        self._schemas[connection.msgtype] = self._writer.register_schema(
            connection.msgtype,
            f'ros2{connection.msgdef.format.name.lower()}',
            connection.msgdef.data.encode(),
        )

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Write down a topic."""
        self._channels[connection.id] = self._writer.register_channel(
            connection.topic,
            'cdr',
            self._schemas[connection.msgtype],
            {'offered_qos_profiles': offered_qos_profiles},
        )

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        """Write a message."""
        count = self._counts[connection.id] = self._counts.get(connection.id, 0) + 1
        channel = self._channels[connection.id]
        self._writer.add_message(channel, timestamp, bytes(data), timestamp, count - 1)

    def close(self, version: int, metadata: str) -> None:
        """Complete the file."""
        self._writer.add_metadata('rosbag2', {'serialized_metadata': metadata})
        self._writer.finish()
        self._file.close()

    def abort(self) -> None:
        """Leave the file as it is."""
        self._file.close()


class BagWriter(Writer):
    """Writes a rosbag2 directory."""

    STORAGE_PLUGINS = {StoragePlugin.MCAP: CheckedMcap}  # noqa: RUF012

    def __init__(self, path: Path):
        """Prepare to write the directory `path`, which must not exist yet."""
        super().__init__(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
