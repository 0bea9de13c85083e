"""The receiving end of the BSC-like link: grant the line, answer every block, and put the message together."""

from __future__ import annotations

from frictid_drivers.motoman.bsc_block import (
    ACK,
    ENQ,
    EOT,
    NAK,
    SOH,
    STX,
    BlockReader,
    BlockReceived,
    BscTiming,
    Event,
    Failed,
    Message,
    Received,
    decode_block,
)


class Receiver:
    """The other side's messages, one after another; what to say, and what happens, is appended to the lists given.

    Attributes:
        timing: may be exchanged.
        deadline_s: when ``expire`` must be called at the latest.
        over: the line is free again.
    """

    def __init__(self, timing: BscTiming, output: bytearray, events: list[Event]) -> None:
        self.timing = timing
        self._output = output
        self._events = events
        self._reader = BlockReader()
        self._header = ""
        self._texts: list[str] = []
        self._complete = False
        """The last block is acknowledged, EOT expected."""
        self._last_answer = b""
        self._repeats = 0
        self._rejections = 0
        self._block_due_s = 0.0
        self._broken = False
        self._last_broken_byte = 0
        self.deadline_s = 0.0
        self.over = True

    def grant(self, now_s: float) -> None:
        """The line is the peer's: ACK0, and a message from its beginning."""
        if self.over or self._complete:
            self._repeats = 0
        elif self._texts:
            self._events.append(Failed("the other side started anew in the middle of a message"))
        self._header, self._texts = "", []
        self._rejections = 0
        self._last_answer = ACK[0]
        self.over = self._complete = False
        self._repeat_answer(now_s)

    def take(self, byte: int, now_s: float) -> None:
        """One byte of the peer's, which holds the line."""
        if self._broken:
            self._break(byte, now_s)
        elif self._reader.open or byte in (SOH, STX):
            self._read(byte, now_s)
        elif byte == ENQ:
            self._asked_for_answer(now_s)
        elif byte == EOT:
            self._peer_ended()
        elif not self._complete and self._texts:
            # A byte that belongs to no block follows an accepted one: that block's end may have been a damaged byte.
            self._give_up("bytes outside any block in the middle of a message")
        elif not self._complete:
            self._block_due_s = now_s + self.timing.text_end_s
            self._break(byte, now_s)

    def expire(self, now_s: float) -> None:
        """Nothing more in time."""
        if self._broken and self._last_broken_byte == EOT:
            self._peer_ended()
        elif self._broken or self._reader.open:
            self._reject(now_s)
        elif self._complete:
            # The peer's EOT was lost; its message was not.
            self.end()
        else:
            self._give_up("the other side fell silent in the middle of a message")

    def end(self) -> None:
        """The line is free."""
        self._reader.clear()
        self._broken = False
        self.over = True

    # -- one block ---------------------------------------------------------------------------------------------

    def _read(self, byte: int, now_s: float) -> None:
        if not self._reader.open:
            self.deadline_s = self._block_due_s = now_s + self.timing.text_end_s
        try:
            raw = self._reader.take(byte)
        except ValueError:
            self._break(byte, now_s)
            return
        if raw is not None:
            self._take_block(raw, now_s)

    def _break(self, byte: int, now_s: float) -> None:
        """This block is lost: discard what comes until the line is quiet, then reject it.

        A control code here may be a damaged byte of the block as well as the peer's impatience; the quiet tells.
        """
        self._broken = True
        self._last_broken_byte = byte
        self.deadline_s = min(now_s + self.timing.quiet_s, self._block_due_s)

    def _take_block(self, raw: bytes, now_s: float) -> None:
        block = decode_block(raw)
        if block is None or not (block.header or self._texts):
            self._reject(now_s)
        elif self._complete:
            # The last block once more: its acknowledgement did not arrive.
            self._repeat_answer(now_s)
        else:
            if block.header:
                # Seen twice, its acknowledgement did not arrive; the message simply starts anew.
                self._header, self._texts = block.header, []
            self._accept(block.text, block.last, now_s)

    def _accept(self, text: str, last: bool, now_s: float) -> None:
        self._events.append(BlockReceived(text, len(self._texts)))
        self._texts.append(text)
        self._rejections = self._repeats = 0
        self._complete = last
        self._answer(ACK[len(self._texts) % 2], now_s)
        if last:
            self._events.append(Received(Message(self._header, "".join(self._texts))))

    # -- answers -----------------------------------------------------------------------------------------------

    def _reject(self, now_s: float) -> None:
        self._rejections += 1
        if self._rejections > self.timing.text_retries + 1:
            self._give_up(f"a block was unreadable {self._rejections} times")
        else:
            self._answer(bytes([NAK]), now_s)

    def _asked_for_answer(self, now_s: float) -> None:
        if not self._texts or self._repeats >= 2:
            # Nothing accepted yet; or the peer has had its answer twice, so its EOT was lost and this is its next bid.
            self.grant(now_s)
        else:
            self._repeat_answer(now_s)

    def _repeat_answer(self, now_s: float) -> None:
        self._repeats += 1
        if self._repeats > self.timing.response_retries + 1:
            self._give_up(f"the other side asked for the same answer {self._repeats} times")
        else:
            self._answer(self._last_answer, now_s)

    def _answer(self, answer: bytes, now_s: float) -> None:
        self._last_answer = answer
        self._output += answer
        # A sender that misses this answer asks after its own timer A; being still here then costs nothing.
        self.deadline_s = now_s + (2 * self.timing.sequence_s if self._complete else self.timing.text_end_s)
        self._reader.clear()
        self._broken = False

    # -- the end -----------------------------------------------------------------------------------------------

    def _peer_ended(self) -> None:
        if not self._complete and self._texts:
            self._events.append(Failed("the other side ended in the middle of a message"))
        self.end()

    def _give_up(self, reason: str) -> None:
        self._output.append(EOT)
        self._events.append(Failed(reason))
        self.end()
