"""The verdict: what the posterior and the gap together allow to be said."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.gap.channel import FAMILY, Term
from frictid_hil.gap.findings import EVEN, Finding, Sampled
from frictid_hil.gap.how_far import Closed, coefficients
from frictid_hil.gap.posterior import VISIBLE, Draw, form_of
from frictid_hil.gap.residuals import rms
from frictid_hil.simulation.effects import all_effects

FLOORS = 2.0  # a gap above so many noise floors is never none, unless it means nothing in practice, by promise
AS_STATED = 0.5  # error of a belief over its one-sigma, below which it is as right as it says
MOST_EXPECTED = 2.0  # the same, above which an error is not to be expected: 95 of 100 beliefs are nearer
FLOORS_AS_STATED = 3.0
"""A gap below so many floors is none, too, if it means nothing in practice and every belief is as right as it says."""
STANDS_OUT = 1.0
"""Size of all causes together, over the floor, below which nothing is named: less than what noise itself makes."""
SHOWS = math.hypot(1.0, STANDS_OUT)  # gap over the floor in which that much is beside the noise
REMAINS = 0.2  # part of a gap that stays, from which on it may hold another cause: 4 % of its power
DOUBTED = 0.89
"""Most that is claimed of causes beyond a tolerance that leave a part of the gap, or close one that functions without
a name would describe as well: less than what counts as sure. Of 41 drawn causes that were held at it, 36 were there."""
HALF = 0.5  # part of a gap from which on it is open although causes were named
VARIES = 1.0 / 3.0  # spread of a cause's strength, over itself, from which on it comes and goes
FORMS_OFF = 2.0  # one-sigma of a form by which it may well be off
HELPS = 0.98  # gap of the validation logs with the causes over that without, above which they explain nothing there
READ_DIRECTLY = "kinematics"  # where a cause is read from positions and velocities themselves
TIED = 0.45  # chance of each of two causes that recordings make alike, a little left for a third
LISTED = 0.25  # chance from which a cause is listed
NEEDED = 0.85
"""Chance that no tolerance makes up for a cause, from which it is told however small the gap is in practice."""
CERTAIN = 0.95
"""Chance of a cause, and of being the largest one, from which it is told although the gap is within noise."""
LEADS = 0.6  # chance of being the largest cause below which a rival makes the answer ambiguous


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is said."""

    word: str  # ``none``, ``explained``, ``ambiguous`` or ``unknown``
    named: tuple[Finding, ...]  # causes that are listed, the first one first
    place: str = ""  # where an unexplained gap lives


def verdict(
    found: Sequence[Finding],  # causes, the largest first
    channels: Sequence[Sampled],  # draws of each channel
    gaps: Sequence[Closed],  # of each channel
    negligible: float,  # gap that means nothing to the user, in the channels' unit
    otherwise_quiet: bool,  # the residual before any filter and the simulated closed loop show no more than noise
    loop_judges: bool = False,  # the closed loop can be simulated
    loop_still: bool = False,  # it shows no gap as large as its noise, and what the controller asks for is a guess
    small: bool = False,  # before any filter, and to half of what is negligible in closed loop, there is no gap
) -> Verdict:
    """Decide."""
    missed = [f for f in found if needed(f, channels) and unreached(f, channels)]
    shown = _shown(found, channels, gaps, otherwise_quiet)
    named = tuple(f for f in found if f.chance >= LISTED and (f in shown or f in missed))
    quiet = otherwise_quiet and all(gap.anywhere <= max(FLOORS * gap.floor, negligible) for gap in gaps)
    explained = _root_sum([channel.explained for channel in channels])
    # What has no name in a demand that is a guess is the guess: there the closed loop tells what stays.
    guessed = [loop_judges and c.posterior.channel.between_rows for c in channels]
    telling = [(c, gap) for c, gap, guess in zip(channels, gaps, guessed, strict=True) if not guess]
    generic, place = _root_sum([c.generic for c, _ in telling]), _place([c for c, _ in telling])
    if any(f.where == READ_DIRECTLY for f in named):
        return Verdict("explained", named)
    told = any(f in missed for f in named)
    if loop_still and otherwise_quiet and not told and all(gap.before <= SHOWS * gap.floor for _, gap in telling):
        return Verdict("none", ())  # whatever causes a guess has
    sure = not _unnamed(channels) and any(_certain(f, channels, gaps) for f in named)
    nothing = not named or (float(np.median(explained)) < STANDS_OUT and not sure)
    generic_wins = float(np.mean(generic > explained)) > 0.5 and float(np.median(generic)) > STANDS_OUT
    loud = [c for c, gap in zip(channels, gaps, strict=True) if gap.before > FLOORS * gap.floor]
    # What identification logs plainly hold is no "none" because the validation logs never came to it.
    known = sure or any(needed(f, channels) for f in named)
    shows = any(gap.before > SHOWS * gap.floor for gap in gaps)
    # A gap that means nothing in practice is none where it hardly shows beside the noise, and up to three floors where
    # every likely cause is as right as is stated.
    floors = FLOORS_AS_STATED if as_stated(named, channels) else SHOWS
    tiny = not told and not sure and not (shows and known)
    tiny = tiny and all(gap.before <= min(floors * gap.floor, negligible) for gap in gaps)
    doubtful = all(f.chance < EVEN for f in named) or not (shows or known)  # within noise, so as well none
    if quiet and (tiny or (not told and (nothing or generic_wins or doubtful))):
        return Verdict("none", ())
    # Where functions without a name describe it as well, the names tell the gap only if they close it, and not at all
    # where those functions make more of it.
    untold = _unnamed([c for c, _ in telling if c in loud]) and any(stays(gap, REMAINS) for _, gap in telling)
    drive = _of_the_drive(telling, named, channels)
    only_drive = drive and quiet and all(expected(f, channels) for f in named)  # none by promise
    unexplained = nothing or generic_wins or untold or drive or any(_open(gap, negligible) for _, gap in telling)
    small = small and all(gap.anywhere <= HALF * negligible for gap in gaps)
    if only_drive or (unexplained and small and _nothing_beyond_tolerance(channels)):
        return Verdict("none", ())
    if unexplained:
        # A link that swings may be no help along the motion, and close the loop all the same.
        return Verdict("unknown", named or tuple(f for f in found if f.chance >= LISTED and swings(f.effect)), place)
    if varies := next((f for f in named if f.chance >= EVEN and _varies(f, channels)), None):
        return Verdict("unknown", named, f"{varies.where}: {varies.effect} that comes and goes")
    if _unnamed(loud) or _off_its_form(loud) or any(stays(gap, REMAINS) for gap in gaps):
        # What stays may be of another cause. An error within its tolerance is to be expected, whatever else is there.
        named = tuple(f if expected(f, channels) else f.at_most(DOUBTED) for f in named)
    first = named[0]
    rivals = [f for f in named[1:] if f.effect in first.rivals or first.effect in f.rivals]
    return Verdict("ambiguous" if first.leads < LEADS and rivals else "explained", named)


def _of_the_drive(
    telling: Sequence[tuple[Sampled, Closed]], named: Sequence[Finding], channels: Sequence[Sampled]
) -> bool:
    """Whether most shows in the drive, which surely does what has no name, and else what a tolerance lets expect."""
    channel, gap = max(telling, key=lambda one: one[1].before / one[1].floor)
    if channel.posterior.channel.of_the_joint or gap.before <= SHOWS * gap.floor:
        return False
    own = [f for f in named if f.where == channel.posterior.channel.name]
    unnamed = [any(e.startswith(FAMILY) for e in draw.model.effects) for draw in channel.draws]
    return float(np.mean(unnamed)) >= CERTAIN and all(expected(f, channels) for f in own)


def _nothing_beyond_tolerance(channels: Sequence[Sampled]) -> bool:
    """Whether hardly a draw needs a cause, or a function without a name, beside the errors that beliefs may have."""
    return all(float(np.mean([not draw.model.effects for draw in c.draws])) >= CERTAIN for c in channels)


def _shown(
    found: Sequence[Finding], channels: Sequence[Sampled], gaps: Sequence[Closed], otherwise_quiet: bool
) -> list[Finding]:
    """Causes that help on the validation logs, and are no more than what a replay between rows may leave by itself.

    Where the closed loop shows a gap that no other cause is likely to make, it is no such leaving.
    """
    helpless = [gap.channel for gap in gaps if gap.after > HELPS * gap.before]
    faint = [gap.channel for c, gap in zip(channels, gaps, strict=True) if _faint(c, gap)]
    plain = [f for f in found if f.where not in helpless and (f.where not in faint or f.size > FLOORS)]
    if otherwise_quiet or any(f.chance >= EVEN for f in plain):
        return plain
    return [f for f in found if f.where not in helpless]


def needed(cause: Finding, channels: Sequence[Sampled]) -> bool:
    """Whether a cause stands out and hardly any draw does without it beyond what its tolerance allows."""
    return cause.chance >= NEEDED and cause.size >= STANDS_OUT and _beyond_tolerance(cause, channels) >= NEEDED


def _beyond_tolerance(cause: Finding, channels: Sequence[Sampled]) -> float:
    """Share of the draws that do not make up for a cause by what its tolerance allows."""
    return max(float(np.mean([cause.effect in draw.model.effects for draw in c.draws])) for c in channels)


def _certain(cause: Finding, channels: Sequence[Sampled], gaps: Sequence[Closed]) -> bool:
    """Whether no doubt is left of a cause and of its name, small as it is, and it takes half of its channel's gap."""
    falls = any(gap.channel == cause.where and not stays(gap, HALF, floors=1.0) for gap in gaps)
    return falls and min(cause.chance, cause.leads, _beyond_tolerance(cause, channels)) >= CERTAIN


def as_stated(found: Sequence[Finding], channels: Sequence[Sampled]) -> bool:
    """Whether all causes that are likelier there than not are errors of the belief, well within its tolerances."""
    stated = _stated(channels)
    likely = [f for f in found if f.chance >= EVEN]
    return bool(likely) and all(f.effect in stated and _within(AS_STATED, f, stated[f.effect]) for f in likely)


def expected(cause: Finding, channels: Sequence[Sampled], one_sigmas: float = MOST_EXPECTED) -> bool:
    """Whether a cause is likely no more than an error of the belief within its tolerance, so many one-sigma at most."""
    if _beyond_tolerance(cause, channels) >= EVEN:
        return False
    stated = _stated(channels)
    return cause.effect not in stated or _within(one_sigmas, cause, stated[cause.effect])


def _stated(channels: Sequence[Sampled]) -> dict[str, Term]:
    """Beliefs about the joint, by the cause that an error of each is."""
    plant = [c.posterior.channel for c in channels if c.posterior.channel.of_the_joint]
    return {t.effect: t for channel in plant for t in channel.nuisances if t.effect and not t.shape}


def _within(one_sigmas: float, error: Finding, belief: Term) -> bool:
    """Whether an error is less than so many one-sigma of the belief that it is of."""
    form = all_effects()[error.effect].inverse
    assert form is not None
    one_sigma = form.parameters({}, belief.deviation)
    return all(abs(v.value) < one_sigmas * abs(one_sigma[name]) for name, v in error.parameters.items())


def unreached(cause: Finding, channels: Sequence[Sampled]) -> bool:
    """Whether the validation logs never come to where a cause shows, so that they say nothing of it."""
    if (found := _first_with(cause, channels)) is None:
        return False
    posterior = found[0].posterior
    columns, values = posterior.contributions(found[1])[cause.effect]
    parts = [log.x[:, columns] @ values for log in posterior.channel.logs if log.validation]
    joined = _levelled if posterior.channel.level_free else np.concatenate
    return bool(parts) and rms(joined(parts)) < VISIBLE * posterior.floor


def _first_with(cause: Finding, channels: Sequence[Sampled]) -> tuple[Sampled, Draw] | None:
    """The channel in which a cause shows most, with its first draw that holds the cause."""
    home = [c for c in channels if c.posterior.channel.name == cause.where]
    return next(((c, d) for c in home for d in c.draws if cause.effect in d.model.effects), None)


def swings(cause: str) -> bool:
    """Whether a cause lets the link swing, so that its columns along a motion may lose the link's phase."""
    return all_effects()[cause].swings


def _varies(cause: Finding, channels: Sequence[Sampled]) -> bool:
    """Whether a cause between demand and torque is stronger at one moment than at another, by ``VARIES`` of itself.

    That channel is replayed exactly, so that what stays has the size of noise. If instead its square grows with the
    square of what the cause makes, by a share v, then the cause's strength has a spread of sqrt(v) of itself.
    """
    if cause.where != "actuation" or (found := _first_with(cause, channels)) is None:
        return False
    channel, draw = found
    columns, values = channel.posterior.contributions(draw)[cause.effect]
    theta, logs = coefficients(channel, draw), channel.posterior.channel.logs
    made = _levelled([(log.x[:, columns] @ values)[log.told] for log in logs])
    about = made**2 - np.mean(made**2)
    rest = _levelled([(log.y - log.x @ theta)[log.told] for log in logs])
    return float(about @ rest**2) > VARIES**2 * float(about @ about)


def _levelled(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([part - np.mean(part) for part in parts])


def _unnamed(loud: Sequence[Sampled]) -> bool:
    """Whether what has no name is a fair part of what channels with a gap hold."""
    generic, explained = _root_sum([c.generic for c in loud]), _root_sum([c.explained for c in loud])
    return float(np.mean(generic > np.maximum(VISIBLE, REMAINS * explained))) > 0.5


def _off_its_form(loud: Sequence[Sampled]) -> bool:
    """Whether what has no name is more than the causes' forms may well be off by: then they may be other causes."""
    off = _root_sum(
        [FORMS_OFF * form_of(name) * sizes for c in loud for name, sizes in c.sizes.items()] or [np.zeros(1)]
    )
    return float(np.mean(_root_sum([c.generic for c in loud]) > np.maximum(VISIBLE, off))) > 0.5


def stays(gap: Closed, part: float, floors: float = FLOORS) -> bool:
    """Whether the named causes leave more than a part of a channel's visible gap, if that has so many floors."""
    visible = max(0.0, gap.before**2 - gap.floor**2)
    return gap.before > floors * gap.floor and gap.after**2 - gap.floor**2 > part**2 * visible


def _faint(channel: Sampled, gap: Closed) -> bool:
    """Whether a gap is no more than what a replay between rows of the logs may leave by itself."""
    return channel.posterior.channel.between_rows and gap.before <= FLOORS * gap.floor


def _open(gap: Closed, negligible: float) -> bool:
    """Whether more than half of a channel's visible gap stays."""
    visible = max(0.0, gap.before**2 - gap.floor**2)
    return gap.after > max(FLOORS * gap.floor, negligible) and gap.after**2 - gap.floor**2 > HALF**2 * visible


def _root_sum(sizes: Sequence[np.ndarray]) -> np.ndarray:
    return np.asarray(np.sqrt(np.sum([size**2 for size in sizes], axis=0)))


def _place(channels: Sequence[Sampled]) -> str:
    """Generic functions that hold most of what no cause explains, in words."""
    loudest = max(channels, key=lambda channel: float(np.median(channel.generic)))
    # Of two as common, the one that is drawn first; a draw's own are in no order.
    counts = Counter(e for draw in loudest.draws for e in sorted(draw.model.effects) if e.startswith(FAMILY))
    words = " and ".join(name.removeprefix(FAMILY) for name, _ in counts.most_common(2))
    return f"{loudest.posterior.channel.name}: {words}" if words else loudest.posterior.channel.name
