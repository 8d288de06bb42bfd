"""What drivers of serial devices share: questions with retries, arrivals of samples, and the watch over what comes.

SerialDriver.connect    open the link, configure the device (Dialogue), which then stays quiet where it can
            .read       let it measure; bytes -> decoder -> samples with the arrival of their first byte (Arrivals),
                        events for whatever a user must know (Care)
"""

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from threading import Event
from typing import Annotated, Generic, Protocol, TypeVar

from msgspec import Meta

from drivers.device import DeviceConfig, DeviceError, SilentError, StreamSpec
from drivers.links import LIVE, SILENCE_S, CountsBadInput, GarbageWatch, Links, SerialPort
from drivers.recognise import describe
from drivers.samples import Chunk, DeviceEvent, ImuSample, Received, Sample
from drivers.serial_ports import BITS_PER_BYTE

ANSWER_S = 0.5
TRIES = 3
READ_S = 0.1
USABLE_SHARE = 0.9
REMEMBERED_READS = 4096
RECOGNISE_BYTES = 4096
LINE_BYTES = 130
TAPE_BLOCK_BYTES = 64
BAUD_HINT = "; is the baud rate right?"
BAUDS = (4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600, 2000000, 4000000)
RATE_AFTER_NS = 5_000_000_000
RATE_TOLERANCE = 0.1

Message = TypeVar("Message")
Answer = TypeVar("Answer")
Decoder = TypeVar("Decoder", bound="SerialDecoder")


class SerialConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of every device on a serial port.

    baud: what the device is set to. keep_dtr: leave the line DTR as it is (boards that are reset by it go on running).
    """

    port: str
    baud: Annotated[int, Meta(gt=0)] = 115200
    keep_dtr: bool = False


class SerialDecoder(CountsBadInput, Protocol):
    """A decoder of a byte stream.

    frames: how many came, of any kind; lost_messages: holes in them, where the protocol shows it.
    starts: for each sample of the last `feed` (or `flush`), how many bytes had been fed before its first byte.
    """

    @property
    def frames(self) -> int:
        """How many frames came."""

    @property
    def lost_messages(self) -> int:
        """How many did not come."""

    @property
    def starts(self) -> list[int]:
        """Where the samples of the last `feed` began."""

    def feed(self, data: bytes) -> list[ImuSample]:
        """The samples that `data` completes."""


class RefusedError(Exception):
    """The device's answer is a no; the message says why."""


@dataclass(slots=True)
class Dialogue(Generic[Message]):
    """Asks a device and waits for its answers.

    cut: gives the messages among the bytes of one read, and takes its arrival. chunks: all bytes both ways.
    """

    link: SerialPort
    cut: Callable[[int, bytes], list[Message]]
    where: str
    chunks: list[Chunk] = field(default_factory=list)

    def ask(self, name: str, request: bytes, answer: Callable[[Message], Answer | None]) -> Answer:
        """What `answer` makes of the device's answer; it gives None for other messages and may raise RefusedError.

        Raises DeviceError when no answer comes, or a refusal.
        """
        refusal = ""
        first = len(self.chunks)
        for _ in range(TRIES):
            self.send(request)
            try:
                if (found := self._wait(answer)) is not None:
                    return found
            except RefusedError as error:
                refusal = str(error)
        if refusal:
            raise DeviceError(f"{self.where}: {name} was refused ({TRIES} tries): {refusal}")
        count = sum(len(chunk.data) for chunk in self.chunks[first:] if not chunk.sent)
        came = f"{count} bytes of other data came" if count else "nothing came at all"
        if count:
            came += describe(b"".join(chunk.data for chunk in self.chunks[first:] if not chunk.sent)) or BAUD_HINT
        raise DeviceError(f"{self.where}: no answer to {name} ({TRIES} tries of {ANSWER_S:g} s; {came})")

    def send(self, data: bytes) -> None:
        """Write and do not wait for an answer."""
        self.chunks.append(self.link.write(data))

    def _wait(self, answer: Callable[[Message], Answer | None]) -> Answer | None:
        deadline_ns = time.monotonic_ns() + int(ANSWER_S * 1e9)
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            arrival_ns, data = self.link.read(left_ns / 1e9)
            if data:
                self.chunks.append(Chunk(arrival_ns, data))
            for message in self.cut(arrival_ns, data):
                if (found := answer(message)) is not None:
                    return found
        return None


@dataclass(slots=True)
class Arrivals:
    """Remembers when the bytes of the last reads came, to tell the arrival of each.

    byte_time_ns: of the line; the stamp of a read belongs to its last byte.
    """

    byte_time_ns: float = 0.0
    last_ns: int = 0
    _bytes: int = 0
    _reads: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=REMEMBERED_READS))

    def note(self, arrival_ns: int, count: int) -> None:
        """`count` bytes were read."""
        self._bytes += count
        self.last_ns = arrival_ns
        self._reads.append((self._bytes, arrival_ns))

    def at(self, offset: int) -> int:
        """Arrival of the byte with so many before it; asked for in ascending order."""
        while self._reads[0][0] <= offset:
            self._reads.popleft()
        end, arrival_ns = self._reads[0]
        return arrival_ns - round((end - 1 - offset) * self.byte_time_ns)


Watch = Callable[[int], tuple[DeviceEvent, ...]]


@dataclass(slots=True)
class Care:
    """Watches a running device: bytes without frames, garbage, and when it has gone silent.

    frames: how many were understood; message: what one is called. cut_bytes: the port may be opened so far inside of
    a frame. watches: what else to look after, asked at each read with its arrival. only_listens: a device that is
    silent has nothing to be told, and its port stays open.
    """

    decoder: CountsBadInput
    frames: Callable[[], int]
    message: str
    where: str
    cut_bytes: int
    silence_s: float = SILENCE_S
    watches: Sequence[Watch] = ()
    is_serial: bool = True
    only_listens: bool = True
    _garbage: GarbageWatch | None = None
    _heard_ns: int | None = None
    _framed_ns: int = 0
    _frames: int = 0
    _warned: bool = False
    _unknown: bytes = b""

    def events(self, arrival_ns: int, data: bytes) -> tuple[DeviceEvent, ...]:
        """What one read tells. Raises DeviceError after a time without any data."""
        if self._heard_ns is None:
            self._heard_ns = self._framed_ns = arrival_ns
        if data:
            self._heard_ns = arrival_ns
        elif arrival_ns - self._heard_ns > self.silence_s * 1e9:
            silence = SilentError if self.only_listens else DeviceError
            raise silence(f"{self.where}: no data for {self.silence_s:g} s")
        frames = self.frames()
        told: tuple[DeviceEvent, ...] = ()
        if frames != self._frames:
            self._frames, self._framed_ns, self._warned = frames, arrival_ns, False
            self._unknown = b""
        elif not self._warned:
            told = self._no_frames(arrival_ns, data)
        for watch in self.watches:
            if events := watch(arrival_ns):
                told += events
        if self._garbage is None:
            if not frames:
                return told
            # What was skipped so far, when it is not much: the port was opened in the middle of a frame.
            is_cut = self.decoder.skipped_bytes <= self.cut_bytes
            now = (self.decoder.bad_frames, self.decoder.skipped_bytes) if is_cut else (0, 0)
            self._garbage = GarbageWatch(self.decoder, now, now)
        return told + self._garbage.events(arrival_ns)

    def _no_frames(self, arrival_ns: int, data: bytes) -> tuple[DeviceEvent, ...]:
        self._unknown = (self._unknown + data)[-RECOGNISE_BYTES:]
        if arrival_ns - self._framed_ns <= self.silence_s * 1e9:
            return ()
        self._warned = True
        looks_like = describe(self._unknown) or (BAUD_HINT if self.is_serial else "")
        text = f"{self.where}: bytes come, but no {self.message} for {self.silence_s:g} s{looks_like}"
        self._unknown = b""
        return (DeviceEvent("warning", text),)


@dataclass(slots=True)
class GapWatch:
    """Tells of messages that the decoder found to be missing."""

    decoder: SerialDecoder
    lost_by: str
    _lost: int = 0

    def __call__(self, arrival_ns: int) -> tuple[DeviceEvent, ...]:
        """The messages lost since the last time."""
        lost = self.decoder.lost_messages - self._lost
        if not lost:
            return ()
        self._lost += lost
        return (DeviceEvent("gap", f"{lost} messages lost, by {self.lost_by}", lost),)


@dataclass(slots=True)
class RateWatch:
    """Tells once when samples come at another rate than expected. is_over: it has made up its mind."""

    rate_hz: float
    where: str
    is_over: bool = False
    _samples: int = 0
    _begin_ns: int | None = None

    def note(self, samples: list[tuple[int, Sample]]) -> None:
        """Take in what one read brought."""
        self._samples += sum(isinstance(sample, ImuSample) and sample.accel_m_s2 is not None for _, sample in samples)

    def __call__(self, arrival_ns: int) -> tuple[DeviceEvent, ...]:
        """The warning, once a few seconds have passed."""
        if self.is_over or not self._samples:
            return ()
        if self._begin_ns is None:
            self._begin_ns, self._samples = arrival_ns, 0
        elif (elapsed_ns := arrival_ns - self._begin_ns) >= RATE_AFTER_NS:
            self.is_over = True
            measured_hz = self._samples * 1e9 / elapsed_ns
            if abs(measured_hz - self.rate_hz) > RATE_TOLERANCE * self.rate_hz:
                text = f"{self.where}: {measured_hz:.1f} samples a second come, and {self.rate_hz:g} were expected"
                return (DeviceEvent("warning", text),)
        return ()


def check_bandwidth(
    port: str, rate_hz: float, baud: int, bytes_per_s: Callable[[float], float], rates_hz: Sequence[float]
) -> None:
    """Raise DeviceError when the line is too slow for the rate, with a rate and a baud rate that would do."""
    needed, usable = bytes_per_s(rate_hz), usable_bytes_per_s(baud)
    if needed <= usable:
        return
    rates = (rate for rate in sorted(rates_hz, reverse=True) if bytes_per_s(rate) <= usable)
    bauds = (faster for faster in BAUDS if needed <= usable_bytes_per_s(faster))
    advice = [f"rate_hz {rate:g} or less" for rate in list(rates)[:1]]
    advice += [f"baud {faster} or more (here and in the device)" for faster in list(bauds)[:1]]
    raise DeviceError(
        f"{port}: {rate_hz:g} Hz need {needed:.0f} bytes/s, and {baud} baud carry {usable:.0f} "
        f"with a margin: set {' or '.join(advice)}"
    )


def usable_bytes_per_s(baud: int) -> float:
    """What a line carries with a margin."""
    return USABLE_SHARE * baud / BITS_PER_BYTE


class SerialDriver(ABC, Generic[Decoder]):
    """One IMU on a serial port: what is the same for all of them.

    message, cut_bytes: see Care. lost_by: how the decoder knows of lost messages.
    """

    wrap_bits = 0
    message = "frame"
    cut_bytes = 512
    lost_by = "the device's counter"

    def __init__(self, config: SerialConfig, rate_hz: float) -> None:
        """Nothing is opened yet."""
        self.links: Links = LIVE
        self._serial = config
        self._rate_hz = rate_hz
        self._identity: dict[str, str] = {}
        self._link: SerialPort | None = None
        self._is_read = False
        self._begun = Received()
        self._early: list[tuple[int, Sample]] = []
        self._renew()

    @property
    def tick_hz(self) -> float:
        """Unit of the samples' device ticks."""
        return 1e9

    @property
    def streams(self) -> tuple[StreamSpec, ...]:
        """One IMU stream, at the rate the device has accepted."""
        size = 2 * LINE_BYTES + TAPE_BLOCK_BYTES + self._sample_bytes()
        return (StreamSpec("imu", self._rate_hz, self._rate_hz * size),)

    @property
    def identity(self) -> dict[str, str]:
        """What the device said of itself, when it was configured by us."""
        return self._identity

    @property
    def where(self) -> str:
        """Port and baud rate, for messages."""
        return f"{self._serial.port} at {self._serial.baud} baud"

    @property
    def _only_listens(self) -> bool:
        return not getattr(self._serial, "configure", False)

    @abstractmethod
    def _sample_bytes(self) -> float:
        """Bytes of a sample on the wire."""

    @abstractmethod
    def _make_decoder(self) -> Decoder:
        """A decoder that has heard nothing yet."""

    def _check(self) -> None:
        """Raise DeviceError for what cannot work, before anything is opened."""

    def _configure(self, link: SerialPort) -> Received:
        """All but the start of the measurement, so that nothing waits in the port. Gives what was said."""
        return Received()

    def _begin(self, link: SerialPort) -> tuple[Chunk, ...]:
        """Let the device measure, or where it does so already throw away what waits: its arrival is not known."""
        if not self._is_read:
            link.discard_input()
        return ()

    def _watches(self) -> Sequence[Watch]:
        """What else to look after while the device measures."""
        return ()

    def _flush(self) -> list[ImuSample]:
        """What is still open at the end."""
        return []

    def _renew(self) -> None:
        """Begin to count and to decode anew."""
        self._decoder = self._make_decoder()
        self._arrivals = Arrivals()
        self._early = []

    def _dialogue(self, link: SerialPort, replies: deque[Message]) -> Dialogue[Message]:
        """A dialogue whose answers the decoder puts into `replies`; samples in between are kept in `_early`."""

        def cut(arrival_ns: int, data: bytes) -> list[Message]:
            self._early += self._stamped(arrival_ns, data)
            messages = list(replies)
            replies.clear()
            return messages

        return Dialogue(link, cut, self.where)

    def _stamped(self, arrival_ns: int, data: bytes) -> list[tuple[int, Sample]]:
        """The samples that one read completes, each with the arrival of its first byte."""
        if data:
            self._arrivals.note(arrival_ns, len(data))
        samples = self._decoder.feed(data)
        return self._with_arrivals(samples) if samples else []

    def _with_arrivals(self, samples: list[ImuSample]) -> list[tuple[int, Sample]]:
        starts = self._decoder.starts
        return [(self._arrivals.at(start), sample) for start, sample in zip(starts, samples, strict=True)]

    def connect(self) -> None:
        """Open the port and configure the device. Raises DeviceError with what was tried."""
        self._check()
        self._renew()
        self._begun = Received()
        if self._link is not None and self._only_listens:
            return
        self.close()
        self._link = self.links.serial(self._serial.port, self._serial.baud, keep_dtr=self._serial.keep_dtr)
        try:
            self._begun = self._configure(self._link)
        except DeviceError:
            self.close()
            raise

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield the handshake, then what comes. Raises DeviceError when the device is gone or silent."""
        if self._link is None:
            raise DeviceError(f"{self._serial.port}: not connected")
        link = self._link
        yield Received(self._begun.chunks, events=(*link.events, *self._begun.events))
        self._renew()  # what came up to here was the measurement that we broke off
        self._arrivals.byte_time_ns = link.byte_time_ns
        chunks = self._begin(link)
        self._is_read = True
        yield Received(chunks, tuple(self._early))
        decoder, rate = self._decoder, RateWatch(self._rate_hz, self.where)
        rate.is_over = self.links is not LIVE  # a capture may be played at any rate
        watches: tuple[Watch, ...] = (GapWatch(decoder, self.lost_by), rate, *self._watches())
        care = Care(
            decoder, lambda: decoder.frames, self.message, self.where, self.cut_bytes,
            watches=watches, only_listens=self._only_listens,
        )  # fmt: skip
        while not stop.is_set():
            arrival_ns, data = link.read(READ_S)
            samples = self._stamped(arrival_ns, data)
            if not rate.is_over:
                rate.note(samples)
            events = care.events(arrival_ns, data)
            if data or events:
                chunks = (Chunk(arrival_ns, data),) if data else ()
                yield Received(chunks, tuple(samples), events)
        if rest := self._flush():
            yield Received(samples=tuple(self._with_arrivals(rest)))

    def close(self) -> None:
        """Close the port; the device goes on measuring."""
        if self._link is not None:
            self._link.close()
            self._link = None
            self._is_read = False
