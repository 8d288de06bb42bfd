"""raw/: what came over the wire, with its arrival, so that everything can be decoded and stamped again.

raw/DEVICE.pcapng holds the bytes of a wire device with nanosecond time stamps and opens in Wireshark: datagrams as
IPv4/UDP packets, serial chunks under a user link type (LINKTYPE_USER0; bytes we sent are marked outbound). Time stamps
are UTC by the host's clock: the arrival on its monotonic clock plus a constant, `utc_at_time_0.host_clock_ns` (where
that is null, `utc_ns`) `- start_monotonic_ns` of recording.json. Format: the pcapng Internet-Draft
(draft-ietf-opsawg-pcapng), sections 4.1 to 4.3.

raw/DEVICE.clock is a table of little-endian int64, three to a row: device ticks, arrival in monotonic ns, and the stamp
that was given online, in ns of recording time: the line's `time` is exactly stamp / 1e9. So each line can be traced to
its ticks and stamped anew.

- A message that is no line of its own (a lidar packet) has NONE as stamp.
- A lidar scan has SCAN_ROWS rows on end, with NONE as arrival (nothing is to be learnt from them): ticks and stamps of
  instants spread evenly over the scan, between which the times of its points are interpolated (recorder.scan_times),
  then the last point's ticks with the stamp of the line.
- The pictures of a frame set have the stamp of their line, a lost one too.
- Samples without device time have no row.

raw/DEVICE.NAME with other names are small files that the device keeps about itself, as it gave them (its calibration).

raw/DEVICE.refined holds one int64 for each row of DEVICE.clock: its time after refinement (see recorder.resync).
"""

import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.samples import Chunk, Datagrams
from recorder.recording.manifest import FileEntry
from recorder.recording.work import ByteQueue, HashedFile, start_thread
from recorder.scan_times import KNOTS

FOLDER = "raw"
QUEUE_BYTES = 64 << 20
FLUSH_S = 0.5
SYNC_S = 1.0
COLLECT_S = 0.1
NONE = -(1 << 63)
SCAN_ROWS = KNOTS + 1
LINKTYPE_RAW_IP = 101
LINKTYPE_USER0 = 147
MAX_SERIAL_PACKET = 65535
Ints = npt.NDArray[np.int64]

_UINT32 = struct.Struct("<I")
_BLOCK_HEAD = struct.Struct("<IIIIIII")  # type, length, interface, time high, time low, captured, original
_IP_UDP = struct.Struct(">BBHHHBBH4s4sHHHH")
_OPTION_OUTBOUND = struct.pack("<HHI", 2, 4, 2) + struct.pack("<HH", 0, 0)  # epb_flags: outbound; end of options


class TapeFile:
    """One pcapng file of one wire device."""

    def __init__(self, path: Path, *, is_serial: bool, utc_minus_monotonic_ns: int) -> None:
        """Create the file with its section and interface headers; it must not exist."""
        self.file = HashedFile(path, 1 << 20)
        self._is_serial = is_serial
        self._offset_ns = utc_minus_monotonic_ns
        self._ip_headers: dict[tuple[object, ...], bytes] = {}
        self.file.write(_section_header() + _interface(LINKTYPE_USER0 if is_serial else LINKTYPE_RAW_IP))

    def write(self, chunk: Chunk) -> None:
        """Append one chunk as an enhanced packet block."""
        if self._is_serial:
            for start in range(0, len(chunk.data), MAX_SERIAL_PACKET):
                self._write_packet(chunk, b"", chunk.data[start : start + MAX_SERIAL_PACKET])
        else:
            self._write_packet(chunk, self._ip_header(chunk), chunk.data)

    def write_many(self, datagrams: Datagrams) -> None:
        """Append datagrams of one length as enhanced packet blocks."""
        count, size = datagrams.data.shape
        header = self._ip_header(datagrams[0])
        captured = len(header) + size
        length = _BLOCK_HEAD.size + captured + -captured % 4 + 4
        payload_at = _BLOCK_HEAD.size + len(header)
        stamp_ns = datagrams.arrival_ns + self._offset_ns
        blocks = np.zeros((count, length), np.uint8)
        head = _BLOCK_HEAD.pack(6, length, 0, 0, 0, captured, captured) + header
        blocks[:, :payload_at] = np.frombuffer(head, np.uint8)
        np.ndarray(count, "<u4", blocks, 12, (length,))[:] = stamp_ns >> 32
        np.ndarray(count, "<u4", blocks, 16, (length,))[:] = stamp_ns & 0xFFFFFFFF
        blocks[:, payload_at : payload_at + size] = datagrams.data
        np.ndarray(count, "<u4", blocks, length - 4, (length,))[:] = length
        self.file.write(blocks.reshape(-1).data)

    def _write_packet(self, chunk: Chunk, header: bytes, payload: bytes) -> None:
        stamp_ns = chunk.arrival_ns + self._offset_ns
        size = len(header) + len(payload)
        padding = b"\0" * (-size % 4)
        options = _OPTION_OUTBOUND if chunk.sent else b""
        length = _BLOCK_HEAD.size + size + len(padding) + len(options) + 4
        head = _BLOCK_HEAD.pack(6, length, 0, stamp_ns >> 32, stamp_ns & 0xFFFFFFFF, size, size)
        self.file.write(b"".join((head, header, payload, padding, options, _UINT32.pack(length))))

    def _ip_header(self, chunk: Chunk) -> bytes:
        """IPv4 and UDP headers; those of one device differ only with the datagram's length."""
        key = (len(chunk.data), chunk.source, chunk.destination)
        header = self._ip_headers.get(key)
        if header is None:
            header = _ip_udp_header(chunk)
            if len(self._ip_headers) < 4096:
                self._ip_headers[key] = header
        return header


def _section_header() -> bytes:
    return struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)


def _interface(link_type: int) -> bytes:
    nanoseconds = struct.pack("<HHB3x", 9, 1, 9) + struct.pack("<HH", 0, 0)  # if_tsresol 10^-9; end of options
    length = 16 + len(nanoseconds) + 4
    return struct.pack("<IIHHI", 1, length, link_type, 0, 0) + nanoseconds + _UINT32.pack(length)


def _ip_udp_header(chunk: Chunk) -> bytes:
    source, source_port = chunk.source or ("0.0.0.0", 0)
    destination, destination_port = chunk.destination or ("0.0.0.0", 0)
    udp_length = 8 + len(chunk.data)
    fields = [
        0x45, 0, min(20 + udp_length, 0xFFFF), 0, 0, 64, 17, 0, _packed_address(source), _packed_address(destination),
        source_port, destination_port, min(udp_length, 0xFFFF), 0,
    ]  # fmt: skip
    words = struct.unpack(">10H", _IP_UDP.pack(*fields)[:20])
    total = sum(words)
    total = (total & 0xFFFF) + (total >> 16)
    fields[7] = ~((total & 0xFFFF) + (total >> 16)) & 0xFFFF
    return _IP_UDP.pack(*fields)


def _packed_address(address: str) -> bytes:
    return bytes(int(part) for part in address.split("."))


def scan_rows(knots: Ints, line_time_ns: int) -> Ints:
    """(SCAN_ROWS, 3): what the clock table keeps of a scan. knots: (KNOTS, 2) ticks and recording time."""
    rows = np.full((SCAN_ROWS, 3), NONE, np.int64)
    rows[:-1, 0], rows[:-1, 2] = knots.T
    rows[-1, 0], rows[-1, 2] = knots[-1, 0], line_time_ns
    return rows


def read_clock_table(path: Path) -> Ints:
    """(n, 3) int64: ticks, arrival, online stamp; half a row at the end of a cut file is left out. Raises OSError."""
    flat = np.fromfile(path, "<i8")
    rows: Ints = flat[: flat.size // 3 * 3].reshape(-1, 3).astype(np.int64)
    return rows


class RawWriter:
    """Writes tapes and clock pairs of all devices in one thread; a full queue drops and counts.

    dropped_bytes: wire bytes that the tape lost for want of room, by device.
    """

    def __init__(
        self, folder: Path, utc_minus_monotonic_ns: int, on_error: Callable[[str, Exception], None], *, tape: bool
    ) -> None:
        """Create the folder raw/; tape False: clock pairs only."""
        self.dropped_bytes: dict[str, int] = {}
        self._folder = folder / FOLDER
        self._folder.mkdir()
        self._offset_ns = utc_minus_monotonic_ns
        self._tape = tape
        self._tapes: dict[str, TapeFile] = {}
        self._plain_files: dict[str, HashedFile] = {}
        self._kept: set[str] = set()
        self._queue: ByteQueue[tuple[str, Sequence[Chunk] | bytes]] = ByteQueue(QUEUE_BYTES)
        self._on_error = on_error
        self._thread = start_thread("raw", self._run, self._failed)

    def put_chunks(self, device: str, chunks: Sequence[Chunk]) -> None:
        """Take what one read brought; never waits."""
        if not self._tape or not chunks:
            return
        # type() here and below: isinstance takes long with an abstract class such as Sequence
        size = chunks.data.nbytes if type(chunks) is Datagrams else sum([len(chunk.data) for chunk in chunks])
        if not self._queue.offer((device, chunks), size + 64 * len(chunks)):
            self.dropped_bytes[device] = self.dropped_bytes.get(device, 0) + size

    def put_clock_rows(self, device: str, pairs: npt.NDArray[np.int64]) -> None:
        """Take (n, 3) int64 rows of the clock table: ticks, arrival, online stamp."""
        data = pairs.astype("<i8").tobytes()
        if not self._queue.offer((f"{device}.clock", data), len(data)):
            self.dropped_bytes[device] = self.dropped_bytes.get(device, 0) + len(data)

    def put_file(self, device: str, name: str, data: bytes) -> None:
        """Take a small file of a device, the first time it comes; waits for room."""
        if f"{device}.{name}" not in self._kept:
            self._kept.add(f"{device}.{name}")
            self._queue.put((f"{device}.{name}", data), len(data))

    def _run(self) -> None:
        last_sync_s = time.monotonic()
        while not self._queue.ended:
            for name, item in self._queue.get_all(FLUSH_S):
                if isinstance(item, bytes):
                    self._plain_file(name).write(item)
                else:
                    tape = self._tape_file(name, item[0])
                    if type(item) is Datagrams:
                        tape.write_many(item)
                    else:
                        for chunk in item:
                            tape.write(chunk)
            for file in self._files().values():
                file.flush()
            if time.monotonic() - last_sync_s >= SYNC_S:
                for file in self._files().values():
                    file.sync()
                    file.forget()
                last_sync_s = time.monotonic()
            time.sleep(COLLECT_S)  # few large writes

    def _files(self) -> dict[str, HashedFile]:
        tapes = {f"{FOLDER}/{device}.pcapng": tape.file for device, tape in self._tapes.items()}
        return tapes | {f"{FOLDER}/{name}": file for name, file in self._plain_files.items()}

    def _tape_file(self, device: str, first: Chunk) -> TapeFile:
        if device not in self._tapes:
            path = self._folder / f"{device}.pcapng"
            is_serial = first.destination is None
            self._tapes[device] = TapeFile(path, is_serial=is_serial, utc_minus_monotonic_ns=self._offset_ns)
        return self._tapes[device]

    def _plain_file(self, name: str) -> HashedFile:
        if name not in self._plain_files:
            self._plain_files[name] = HashedFile(self._folder / name)
        return self._plain_files[name]

    def _failed(self, name: str, error: Exception) -> None:
        self._on_error(name, error)
        while not self._queue.ended:
            self._queue.get_all(0.5)

    def close(self) -> dict[str, FileEntry]:
        """Write what is left, durably; gives size and hash of each file."""
        self._queue.close()
        self._thread.join()
        entries: dict[str, FileEntry] = {}
        faults: list[OSError] = []
        for name, file in self._files().items():
            try:
                entries[name] = file.close()
            except OSError as error:
                faults.append(error)
        if faults:
            raise faults[0]
        return entries
