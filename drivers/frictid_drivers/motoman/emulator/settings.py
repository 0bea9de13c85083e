"""How an emulated controller is made."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Every default is that of the real one, where it is known."""

    generation: str = "nx"  # erc, xrc, nx or dx; decides the bits of RSTATS
    baud: int = 19200  # of host control
    parity: str = "E"  # E, O or N; a byte costs 11 bits with, 10 without
    timer_a_s: float = 3.0  # RS034: answer to ENQ or to a text
    timer_b_s: float = 20.0  # RS035: end of a text
    retry_1: int = 10  # RS036: invalid or no response
    retry_2: int = 3  # RS037: NAK to a text
    hush_s: float = 0.1  # silence after which rubbish on the line has ended
    stream_bauds: tuple[int, ...] = (115200, 921600)  # speeds that FSTREAM may ask for; none on an ordinary port
    batch: bool = True  # the batch application is installed
    tick_s: float = 0.004  # interpolation clock
    averaging_ticks: int = 1  # moving average on the command; 1 is none
    thinking_s: float = 0.012  # between a command and the bid to reply
    table_delay_ticks: int = 0  # between the tick that a table's torque is computed in and the tick that it acts in
    reads_while_running: bool = True  # the batch application hands samples over while a job runs (FREAD 2)

    @property
    def tick_us(self) -> int:
        """Interpolation clock."""
        return round(self.tick_s * 1e6)

    @property
    def averaging_ms(self) -> int:
        """Moving average on the command; 0 is none."""
        return round((self.averaging_ticks - 1) * self.tick_s * 1000)
