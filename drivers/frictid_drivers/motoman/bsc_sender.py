"""The sending end of the BSC-like link: bid for the line, say block after block, and make sure of every answer."""

from __future__ import annotations

from collections.abc import Sequence

from frictid_drivers.motoman.bsc_block import DLE, ENQ, EOT, NAK, BscTiming, Failed, Sent


class Yielded:
    """Both sides bid for the line, and it is the other one's now."""


Outcome = Sent | Failed | Yielded | None
"""How the sending ended; None while it goes on."""


class Sender:
    """One message on its way, once ``bid`` for; what to say is appended to ``output``.

    Attributes:
        timing: may be exchanged.
        deadline_s: when ``expire`` must be called at the latest.
        contended: the other side bid at the same moment.
    """

    def __init__(self, timing: BscTiming, output: bytearray) -> None:
        self.timing = timing
        self._output = output
        self.contended = self._dle_seen = False

    def bid(self, blocks: Sequence[bytes], now_s: float) -> None:
        """Ask for the line, to send these."""
        self._blocks = blocks
        self._index = -1
        """The block under way, -1 while bidding."""
        self._response_retries = self._text_retries = self._contentions = 0
        self._asked_again = False
        self._output.append(ENQ)
        self._await_answer(now_s)

    def take(self, byte: int, now_s: float) -> Outcome:
        """One byte of an answer."""
        after_dle, self._dle_seen = self._dle_seen, byte == DLE
        if after_dle and byte in (0x30, 0x31):
            return self._acknowledged(byte - 0x30, now_s)
        if byte == NAK:
            return self._rejected(now_s)
        if byte == EOT and not self._bidding:
            return Failed("the other side ended the transmission")
        if byte == ENQ and self._bidding:
            return self._contention(now_s)
        return self._garbled(now_s)

    def expire(self, now_s: float) -> Outcome:
        """No answer in time."""
        self._response_retries += 1
        if self._response_retries > self.timing.response_retries:
            what = "ENQ" if self._bidding else "a block"
            return self._give_up(f"no answer to {what}, asked {self._response_retries} times")
        return self._ask_again(now_s)

    # -- inside ------------------------------------------------------------------------------------------------

    @property
    def _bidding(self) -> bool:
        return self._index < 0

    def _acknowledged(self, number: int, now_s: float) -> Outcome:
        if self._bidding:
            return self._next_block(now_s) if number == 0 else self._garbled(now_s)
        if number == (self._index + 1) % 2:
            return self._next_block(now_s)
        if not self._asked_again:
            return self._garbled(now_s)
        # Asked again, the other side repeats the acknowledgement of the block before: this one never arrived.
        self._response_retries += 1
        if self._response_retries > self.timing.response_retries:
            return self._give_up(f"a block was never acknowledged, sent {self._response_retries} times")
        return self._send_block(now_s)

    def _next_block(self, now_s: float) -> Outcome:
        if not self._bidding:
            self._response_retries = self._text_retries = 0
        self._index += 1
        if self._index < len(self._blocks):
            return self._send_block(now_s)
        self._output.append(EOT)
        return Sent()

    def _rejected(self, now_s: float) -> Outcome:
        if self._bidding:
            # Not ready to receive: the same ENQ again, a little later.
            return self._garbled(now_s)
        if self._index > 0 and not self._asked_again:
            # An acknowledgement damaged into a NAK would double a continuation block, which carries no number.
            return self._ask_again(now_s)
        self._text_retries += 1
        if self._text_retries > self.timing.text_retries:
            return self._give_up(f"a block was rejected (NAK) {self._text_retries} times")
        return self._send_block(now_s)

    def _contention(self, now_s: float) -> Outcome:
        """Both bid at once: hold on the first time, yield the second.

        That ends it against a controller that yields at once as well as against one that never does.
        """
        self._contentions += 1
        self.contended = True
        return self._garbled(now_s) if self._contentions == 1 else Yielded()

    def _garbled(self, now_s: float) -> Outcome:
        """An answer that is none, or half of one: wait until the line is quiet, then ask again."""
        self.deadline_s = min(now_s + self.timing.quiet_s, self._answer_due_s)
        return None

    def _ask_again(self, now_s: float) -> Outcome:
        self._asked_again = True
        self._output.append(ENQ)
        self._await_answer(now_s)
        return None

    def _send_block(self, now_s: float) -> Outcome:
        self._asked_again = False
        self._output += self._blocks[self._index]
        self._await_answer(now_s)
        return None

    def _await_answer(self, now_s: float) -> None:
        self.deadline_s = self._answer_due_s = now_s + self.timing.sequence_s
        self._dle_seen = False

    def _give_up(self, reason: str) -> Failed:
        self._output.append(EOT)
        return Failed(reason)
