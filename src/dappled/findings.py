"""What was found, as values: code, level, what it is about, and facts; `findings.toml` has the words of each code.

Two findings are of one kind when code and subject are equal, whatever their numbers. Only this module builds their
sentences; no code reads a sentence back.
"""

from __future__ import annotations

import json
import math
import string
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum
from importlib import resources
from types import MappingProxyType
from typing import Any, Self, TypeAlias

from dappled import codec

Value: TypeAlias = str | int | float | bool | None


class Text:
    """Words for people. Nothing can compare, search or split them; a face prints them by `str`."""

    __slots__ = ("_words",)

    def __init__(self, words: str) -> None:
        self._words = words

    def __str__(self) -> str:
        return self._words

    def __bool__(self) -> bool:
        return bool(self._words)


# What a result was made with, beside its own frames: its findings are told with its name.
_BESIDE = frozenset({"bare frames", "calibration", "white frame"})
_NO_FACTS: Mapping[str, Value] = MappingProxyType({})


class Level(IntEnum):
    """How much a finding weighs. Above `NOTE` nothing is "go", and a result is in doubt."""

    NOTE = 0
    CAUTION = 1
    STOP = 2

    @property
    def word(self) -> str:
        """The level as JSON and people have it."""
        return self.name.lower()


class Code(StrEnum):
    """What can be found. The part before the dot names what it is about; `findings.toml` has the words."""

    APERTURE_DISAGREES = "aperture.disagrees"
    APERTURE_UNEXPLAINED = "aperture.unexplained"
    BATTERY_VEHICLE_LOW = "battery.vehicle_low"
    BODY_BATTERY_LOW = "body.battery_low"
    BODY_CARD_FILLING = "body.card_filling"
    BODY_CARD_FULL = "body.card_full"
    BODY_DRIFT = "body.drift"
    BODY_HOT = "body.hot"
    BODY_SETTING_WRONG = "body.setting_wrong"
    BODY_UNCHECKED = "body.unchecked"
    BODY_UNREAD = "body.unread"
    BODY_UNREPORTED = "body.unreported"
    CALIBRATION_OTHER_LAW = "calibration.other_law"
    CALIBRATION_OTHER_MASK = "calibration.other_mask"
    CALIBRATION_OTHER_SIZE = "calibration.other_size"
    CAMERA_ABSENT = "camera.absent"
    CAMERA_CLOCK_FAR = "camera.clock_far"
    CAMERA_FAULTED = "camera.faulted"
    CAMERA_FIRED_OUTSIDE = "camera.fired_outside"
    CAMERA_READY = "camera.ready"
    CAMERA_REFUSED = "camera.refused"
    CAMERA_SHOTS_WAITING = "camera.shots_waiting"
    CAMERA_STARTING = "camera.starting"
    CAMERA_UNOPENED = "camera.unopened"
    CARD_CHANGED = "card.changed"
    CARD_NOT_LISTED = "card.not_listed"
    CARD_PICTURES_LEFT = "card.pictures_left"
    CARRIERS_BY_LAW = "carriers.by_law"
    CARRIERS_CUT = "carriers.cut"
    CARRIERS_DISPLACED = "carriers.displaced"
    CARRIERS_ELSEWHERE = "carriers.elsewhere"
    CARRIERS_FEW = "carriers.few"
    CARRIERS_FULL_MASK = "carriers.full_mask"
    CARRIERS_HALF_WAY = "carriers.half_way"
    CARRIERS_LACKING = "carriers.lacking"
    CARRIERS_MISSING = "carriers.missing"
    CARRIERS_OFF_CALIBRATION = "carriers.off_calibration"
    CARRIERS_OTHER_LAW = "carriers.other_law"
    CARRIERS_OTHER_PEAKS = "carriers.other_peaks"
    CARRIERS_OTHER_SIZE = "carriers.other_size"
    CARRIERS_REPLACED = "carriers.replaced"
    CARRIERS_SEEN = "carriers.seen"
    CARRIERS_SOME_ABSENT = "carriers.some_absent"
    CARRIERS_TOO_FEW = "carriers.too_few"
    CARRIERS_UNCHECKED = "carriers.unchecked"
    CARRIERS_UNCONFIRMED = "carriers.unconfirmed"
    CARRIERS_UNOBSERVABLE = "carriers.unobservable"
    CARRIERS_UNSEARCHED = "carriers.unsearched"
    CARRIERS_UNSEEN = "carriers.unseen"
    CHAIN_BROKEN = "chain.broken"
    CHAIN_EMPTY = "chain.empty"
    CHAIN_LACKS = "chain.lacks"
    CHAIN_REMOVED = "chain.removed"
    CLOCK_AUTOPILOT_UNKNOWN = "clock.autopilot_unknown"
    CLOCK_DATE_UNKNOWN = "clock.date_unknown"
    CLOCK_LOOSE = "clock.loose"
    CLOCK_NOT_REAL_TIME = "clock.not_real_time"
    CLOCK_STEPPED = "clock.stepped"
    CLOCK_SYNCHRONISED = "clock.synchronised"
    CLOCK_UNSTEADY = "clock.unsteady"
    CLOCK_UNSYNCHRONISED = "clock.unsynchronised"
    CLOCK_UTC_UNKNOWN = "clock.utc_unknown"
    COPY_IN_MEMORY = "copy.in_memory"
    COPY_MAY_NOT_LAST = "copy.may_not_last"
    COPY_REMOTE = "copy.remote"
    DECODE_BEHIND = "decode.behind"
    DECODE_FAILED = "decode.failed"
    DECODE_FAILING = "decode.failing"
    DECODE_LAW_DECIDED = "decode.law_decided"
    DECODE_MISFIT = "decode.misfit"
    DECODE_NO_MASK = "decode.no_mask"
    DECODE_OFF = "decode.off"
    DECODE_UNCALIBRATED = "decode.uncalibrated"
    DISK_CLOSED = "disk.closed"
    DISK_FEW_FILES = "disk.few_files"
    DISK_FEW_FRAMES = "disk.few_frames"
    DISK_FILLING = "disk.filling"
    DISK_FULL = "disk.full"
    DISK_NEARLY_FULL = "disk.nearly_full"
    DISK_ROOM = "disk.room"
    DISK_UNREADABLE = "disk.unreadable"
    FILE_ADOPTED = "file.adopted"
    FILE_ADOPTED_BESIDE = "file.adopted_beside"
    FILE_CHANGED = "file.changed"
    FILE_HALF_WRITTEN = "file.half_written"
    FILE_LINKED = "file.linked"
    FILE_MISSING = "file.missing"
    FILE_NO_SHOT = "file.no_shot"
    FILE_NO_TRIGGER = "file.no_trigger"
    FILE_NOT_FOLLOWED = "file.not_followed"
    FILE_OTHER_SIZE = "file.other_size"
    FILE_OUTSIDE = "file.outside"
    FILE_PART_REMOVED = "file.part_removed"
    FILE_SECOND = "file.second"
    FILE_SPECIAL = "file.special"
    FILE_UNASKED = "file.unasked"
    FILE_UNCLAIMED = "file.unclaimed"
    FILE_UNLISTED = "file.unlisted"
    FILE_UNREADABLE = "file.unreadable"
    FLIGHT_COPY_UNFINISHED = "flight.copy_unfinished"
    FLIGHT_CUT_SHORT = "flight.cut_short"
    FLIGHT_EMPTY_FOLDER = "flight.empty_folder"
    FLIGHT_FILES_REMOVED = "flight.files_removed"
    FLIGHT_FOLDER_REMOVED = "flight.folder_removed"
    FLIGHT_LEFT_OPEN = "flight.left_open"
    FLIGHT_NEXT_BEGINS = "flight.next_begins"
    FLIGHT_OFFLOADED = "flight.offloaded"
    FLIGHT_PART_DAMAGED = "flight.part_damaged"
    FLIGHT_PART_UNREAD = "flight.part_unread"
    FLIGHT_PUT_RIGHT = "flight.put_right"
    FLIGHT_RENAMED = "flight.renamed"
    FLIGHT_UNCLOSED = "flight.unclosed"
    FLIGHT_UNREADABLE = "flight.unreadable"
    FLIGHT_UNREPAIRED = "flight.unrepaired"
    FLIGHT_VEHICLE_UNDECIDED = "flight.vehicle_undecided"
    FRAME_BLACK = "frame.black"
    FRAME_BLUR_UNKNOWN = "frame.blur_unknown"
    FRAME_BLURRED = "frame.blurred"
    FRAME_CLIPPED = "frame.clipped"
    FRAME_CLOCK_DISAGREES = "frame.clock_disagrees"
    FRAME_DARK = "frame.dark"
    FRAME_DEFOCUSED = "frame.defocused"
    FRAME_DEVELOPED = "frame.developed"
    FRAME_DROPPED = "frame.dropped"
    FRAME_EXPOSED = "frame.exposed"
    FRAME_FOCUS_UNKNOWN = "frame.focus_unknown"
    FRAME_JUDGED_BAD = "frame.judged_bad"
    FRAME_LEFT = "frame.left"
    FRAME_MOTION_UNKNOWN = "frame.motion_unknown"
    FRAME_OFF_PLAN = "frame.off_plan"
    FRAME_REFUSED = "frame.refused"
    FRAME_REQUEST_LATE = "frame.request_late"
    FRAME_RIVAL_PICTURE = "frame.rival_picture"
    FRAME_RIVAL_SHOTS = "frame.rival_shots"
    FRAME_SHARP = "frame.sharp"
    FRAME_SMEARED = "frame.smeared"
    FRAME_STEADY = "frame.steady"
    FRAME_UNCONFIRMED = "frame.unconfirmed"
    FRAME_UNDECODABLE = "frame.undecodable"
    FRAME_UNDERGROUND = "frame.underground"
    FRAME_UNJUDGED = "frame.unjudged"
    FRAME_UNMASKED = "frame.unmasked"
    FRAME_UNPLACED = "frame.unplaced"
    FRAME_UNREADABLE = "frame.unreadable"
    FRAME_UNSHARP = "frame.unsharp"
    FRAME_VIGNETTED = "frame.vignetted"
    FRAMES_BAD = "frames.bad"
    FRAMES_LENS_MOVED = "frames.lens_moved"
    GIMBAL_UNHEARD = "gimbal.unheard"
    GNSS_DAMAGED = "gnss.damaged"
    GNSS_FAILING = "gnss.failing"
    GNSS_NO_RAW = "gnss.no_raw"
    GNSS_NO_UBX = "gnss.no_ubx"
    GNSS_SILENT = "gnss.silent"
    INDEX_REBUILT = "index.rebuilt"
    INDEX_TAKEN = "index.taken"
    JOURNAL_LINE_AGAIN = "journal.line_again"
    JOURNAL_LINE_DAMAGED = "journal.line_damaged"
    JOURNAL_MORE_LINES = "journal.more_lines"
    JOURNAL_TORN = "journal.torn"
    KIT_BLIND = "kit.blind"
    KIT_DARK = "kit.dark"
    KIT_DISTANCE_OPEN = "kit.distance_open"
    KIT_DISTANCE_UNCERTAIN = "kit.distance_uncertain"
    KIT_DISTANCES_DISAGREE = "kit.distances_disagree"
    KIT_FILM_IN = "kit.film_in"
    KIT_FULL_FILM_IN = "kit.full_film_in"
    KIT_LAW_OPEN = "kit.law_open"
    KIT_LAWS_DISAGREE = "kit.laws_disagree"
    KIT_MIXED_UP = "kit.mixed_up"
    KIT_NO_BARE = "kit.no_bare"
    KIT_PRINT_SIZE = "kit.print_size"
    KIT_PRINTS_DISAGREE = "kit.prints_disagree"
    KIT_SHOTS_MISSING = "kit.shots_missing"
    KIT_UNSEEN = "kit.unseen"
    LATTICE_WEAK = "lattice.weak"
    LAW_ASKED = "law.asked"
    LAW_BOTH = "law.both"
    LAW_EXPLAINS = "law.explains"
    LAW_NEITHER = "law.neither"
    LAW_ONLY = "law.only"
    LEDGER_DAMAGED = "ledger.damaged"
    LEDGER_DIGEST_WRONG = "ledger.digest_wrong"
    LEDGER_REBUILT = "ledger.rebuilt"
    LEDGER_ROW_ADDED = "ledger.row_added"
    LEDGER_ROW_CHANGED = "ledger.row_changed"
    LEDGER_ROW_REMOVED = "ledger.row_removed"
    LEDGER_ROW_REWRITTEN = "ledger.row_rewritten"
    LEDGER_ROWS_UNREAD = "ledger.rows_unread"
    LEDGER_TWO_HASHES = "ledger.two_hashes"
    LENS_NO_FOCAL_LENGTH = "lens.no_focal_length"
    LENS_TOLD = "lens.told"
    LENS_UNTOLD = "lens.untold"
    LIBRARY_FOUND = "library.found"
    LIBRARY_MISSING = "library.missing"
    LINK_CLOCK_AHEAD = "link.clock_ahead"
    LINK_CLOCK_BEHIND = "link.clock_behind"
    LINK_DOWN = "link.down"
    LINK_NAMED = "link.named"
    LINK_NONE = "link.none"
    LINK_OTHER_COMPONENT = "link.other_component"
    LINK_OTHER_SYSTEM = "link.other_system"
    LINK_REFUSED = "link.refused"
    LINK_SAME_IDS = "link.same_ids"
    LINK_SILENT = "link.silent"
    LINK_UNOPENED = "link.unopened"
    LINK_VEHICLE = "link.vehicle"
    LOG_BYTES_SKIPPED = "log.bytes_skipped"
    LOG_CORE = "log.core"
    LOG_CUT_SHORT = "log.cut_short"
    LOG_FRAMES_UNPLACED = "log.frames_unplaced"
    LOG_NO_TRIGGER = "log.no_trigger"
    LOG_RECEIVER_BETTER = "log.receiver_better"
    LOG_RECEIVER_USED = "log.receiver_used"
    LOG_STAMPS_UNSET = "log.stamps_unset"
    LOG_UNWRITTEN = "log.unwritten"
    LOG_VALUES_MISSING = "log.values_missing"
    LOG_VEHICLE = "log.vehicle"
    MACHINE_FEW_DESCRIPTORS = "machine.few_descriptors"
    MACHINE_LITTLE_MEMORY = "machine.little_memory"
    MARK_AWAY = "mark.away"
    MARK_BOUNCED = "mark.bounced"
    MARK_OF_NO_FRAME = "mark.of_no_frame"
    MARK_OF_NO_SHOT = "mark.of_no_shot"
    MARKS_ARMLESS = "marks.armless"
    MARKS_CUT_SHORT = "marks.cut_short"
    MARKS_HEIGHTS_DIFFER = "marks.heights_differ"
    MARKS_NOT_FIXED = "marks.not_fixed"
    MARKS_NOT_MOVED = "marks.not_moved"
    MARKS_UNPLACED = "marks.unplaced"
    MARKS_UNTIMED = "marks.untimed"
    MASK_NAMED = "mask.named"
    MASK_SHIFTED = "mask.shifted"
    MASK_TURNED = "mask.turned"
    MASK_UNMAKABLE = "mask.unmakable"
    PEER_DISPLACED = "peer.displaced"
    PEER_GUESS_BY_PAGE = "peer.guess_by_page"
    PEER_GUESS_WRONG = "peer.guess_wrong"
    PEER_GUESSES = "peer.guesses"
    PEER_HANDSHAKE_FAILED = "peer.handshake_failed"
    PEER_HANDSHAKE_SLOW = "peer.handshake_slow"
    PEER_KEY_UNLISTED = "peer.key_unlisted"
    PEER_NOT_HTTP = "peer.not_http"
    PEER_NOT_TAKEN = "peer.not_taken"
    PEER_NOT_ZEROMQ = "peer.not_zeromq"
    PEER_OTHER_HOST = "peer.other_host"
    PEER_OTHER_PROTOCOL = "peer.other_protocol"
    PEER_READS_NOTHING = "peer.reads_nothing"
    PEER_SAYS_TOO_MUCH = "peer.says_too_much"
    PEER_SILENT = "peer.silent"
    PEER_TOO_MANY = "peer.too_many"
    PEER_WRONG_REQUEST = "peer.wrong_request"
    PICKUP_AS_TOLD = "pickup.as_told"
    PICKUP_BY_ORDER = "pickup.by_order"
    PICKUP_BY_TIME = "pickup.by_time"
    PICTURE_CLIPPED = "picture.clipped"
    PICTURE_DARK = "picture.dark"
    PICTURE_DEVELOPED = "picture.developed"
    PICTURE_NAMES_DISAGREE = "picture.names_disagree"
    PICTURE_ON_CARD = "picture.on_card"
    PICTURE_RIVAL_SHOTS = "picture.rival_shots"
    PICTURE_SHADOW_UNCERTAIN = "picture.shadow_uncertain"
    PICTURE_SHADOW_UNSEEN = "picture.shadow_unseen"
    PICTURE_SOFT = "picture.soft"
    PICTURE_TIME_DISAGREES = "picture.time_disagrees"
    PICTURE_UNDATED = "picture.undated"
    POSE_FEW_POINTS = "pose.few_points"
    POSE_NO_OVERLAP = "pose.no_overlap"
    POSE_POINTS_DISAGREE = "pose.points_disagree"
    POSE_RULED_OUT = "pose.ruled_out"
    POSE_UNMATCHED = "pose.unmatched"
    POSITION_COARSE = "position.coarse"
    POSITION_FAR_TELEMETRY = "position.far_telemetry"
    POSITION_IMPOSSIBLE = "position.impossible"
    POSITION_JUMPED = "position.jumped"
    POSITION_NO_ATTITUDE = "position.no_attitude"
    POSITION_NO_FIX = "position.no_fix"
    POSITION_NOT_INTERPOLATED = "position.not_interpolated"
    POSITION_RECEIVER_SILENT = "position.receiver_silent"
    POSITION_SIGMA_UNKNOWN = "position.sigma_unknown"
    POSITION_TIME_DOUBTED = "position.time_doubted"
    POSITION_TOO_COARSE = "position.too_coarse"
    POSITION_UNHEARD = "position.unheard"
    POSITION_UNKNOWN = "position.unknown"
    POSITION_UNSURE = "position.unsure"
    POSITION_WEAK_FIX = "position.weak_fix"
    POSITION_WITHOUT_FIX = "position.without_fix"
    REPLAY_DIFFERENT = "replay.different"
    REPLAY_NO_HASH = "replay.no_hash"
    REPLAY_NOT_MADE = "replay.not_made"
    REPLAY_NUMBERS_DIFFER = "replay.numbers_differ"
    REPLAY_NUMBERS_LACKING = "replay.numbers_lacking"
    REPLAY_OTHER_EVENT = "replay.other_event"
    REPLAY_OTHER_FILE = "replay.other_file"
    REPLAY_OTHER_SHAPE = "replay.other_shape"
    REPLAY_SLICES_DIFFER = "replay.slices_differ"
    SEAL_ANOTHER_FLIGHT = "seal.another_flight"
    SEAL_BY_OWNER = "seal.by_owner"
    SEAL_CHANGED = "seal.changed"
    SEAL_CONTRADICTS_CHAIN = "seal.contradicts_chain"
    SEAL_DIGESTS_DIFFER = "seal.digests_differ"
    SEAL_FILE_ADDED = "seal.file_added"
    SEAL_FILE_CHANGED = "seal.file_changed"
    SEAL_FILE_MISSING = "seal.file_missing"
    SEAL_FILE_UNREADABLE = "seal.file_unreadable"
    SEAL_INPUT_ADDED = "seal.input_added"
    SEAL_LEDGER_CHANGED = "seal.ledger_changed"
    SEAL_LINE_CHANGED = "seal.line_changed"
    SEAL_LINE_TORN = "seal.line_torn"
    SEAL_LINE_UNLINKED = "seal.line_unlinked"
    SEAL_LOST = "seal.lost"
    SEAL_MORE_THAN_LINKS = "seal.more_than_links"
    SEAL_NONE = "seal.none"
    SEAL_NOT_SIGNED = "seal.not_signed"
    SEAL_OTHER_KEY = "seal.other_key"
    SEAL_REWRITTEN = "seal.rewritten"
    SEAL_SIGNATURE_WRONG = "seal.signature_wrong"
    SEAL_SIGNED = "seal.signed"
    SEAL_SIGNED_IN_PART = "seal.signed_in_part"
    SEAL_SIGNED_UNTIL = "seal.signed_until"
    SEAL_TWICE = "seal.twice"
    SEAL_UNCOVERED = "seal.uncovered"
    SEAL_UNKNOWN = "seal.unknown"
    SEAL_UNSEALED = "seal.unsealed"
    SEAL_UNVERIFIED = "seal.unverified"
    SEAL_UNWRITTEN = "seal.unwritten"
    SERIES_LATE = "series.late"
    SERIES_NO_FIELD = "series.no_field"
    SERIES_NO_HEIGHT = "series.no_height"
    SERIES_NO_POSITION = "series.no_position"
    SERIES_OLD_POSITION = "series.old_position"
    SERIES_TOO_LOW = "series.too_low"
    SERVICE_STOPPING = "service.stopping"
    SETTINGS_DIFFER = "settings.differ"
    SETTINGS_SIMULATED = "settings.simulated"
    SETTINGS_UNREAD = "settings.unread"
    SHOT_CONTRADICTED = "shot.contradicted"
    SHOT_CUT_OFF = "shot.cut_off"
    SHOT_DIFFERS = "shot.differs"
    SHOT_ENTERED = "shot.entered"
    SHOT_FAILED = "shot.failed"
    SHOT_FOLLOWS = "shot.follows"
    SHOT_INTERVAL_BOUNDS = "shot.interval_bounds"
    SHOT_LOST = "shot.lost"
    SHOT_NO_TRIGGER = "shot.no_trigger"
    SHOT_NOT_IN_JOURNAL = "shot.not_in_journal"
    SHOT_NOT_IN_LEDGER = "shot.not_in_ledger"
    SHOT_NOT_NOTED = "shot.not_noted"
    SHOT_NOTED_AGAIN = "shot.noted_again"
    SHOT_OPEN = "shot.open"
    SHOT_UNRECORDED = "shot.unrecorded"
    SHOT_WITHOUT_FRAME = "shot.without_frame"
    STAGE_BEHIND = "stage.behind"
    TAG_OTHER_BYTES = "tag.other_bytes"
    TASK_FAILING = "task.failing"
    TELEMETRY_BLOCK_CHANGED = "telemetry.block_changed"
    TELEMETRY_BLOCKS_MISSING = "telemetry.blocks_missing"
    TELEMETRY_CHANGED = "telemetry.changed"
    TELEMETRY_MISSING = "telemetry.missing"
    TELEMETRY_NONE = "telemetry.none"
    TELEMETRY_SLOW = "telemetry.slow"
    THREAD_ENDED = "thread.ended"
    TIME_IMPOSSIBLE = "time.impossible"
    TIME_MACHINE_DIFFERS = "time.machine_differs"
    TIME_PUT_RIGHT = "time.put_right"
    TIME_RECEIVERS_DIFFER = "time.receivers_differ"
    TIME_TRIGGER_UNUSABLE = "time.trigger_unusable"
    TIME_WEEK_MENDED = "time.week_mended"
    TIME_WEEK_ROLLOVER = "time.week_rollover"
    TRIGGER_COUNTER_SET = "trigger.counter_set"
    TRIGGER_JUMP = "trigger.jump"
    TRIGGER_LOST = "trigger.lost"
    TRIGGER_NO_SHOT = "trigger.no_shot"
    TRIGGER_PASSED_OVER = "trigger.passed_over"
    TRIGGER_TWICE = "trigger.twice"
    TRIGGER_TWO_SHOTS = "trigger.two_shots"
    TRIGGER_UNHEARD = "trigger.unheard"
    TRIGGER_UNREPORTED = "trigger.unreported"
    USB_ABSENT = "usb.absent"
    USB_DESKTOP = "usb.desktop"
    USB_FILES_ONLY = "usb.files_only"
    USB_FORBIDDEN = "usb.forbidden"
    USB_HELD = "usb.held"
    USB_HELD_BY_DESKTOP = "usb.held_by_desktop"
    USB_READY = "usb.ready"
    USB_UNNEEDED = "usb.unneeded"
    USB_WRONG_MODE = "usb.wrong_mode"
    VIEWS_CONTRADICTED = "views.contradicted"
    VIEWS_OUT_OF_REACH = "views.out_of_reach"


@dataclass(frozen=True, slots=True, order=True)
class Subject:
    """What a finding is about: a kind (flight, frame, shot, picture, file, link, log, argument, service) and which one.

    >>> str(Subject("frame", 42)), str(Subject("flight"))
    ('frame 42', 'flight')
    """

    kind: str
    which: str | int = ""

    def __str__(self) -> str:
        return f"{self.kind} {self.which}" if self.which != "" else self.kind


FRAME = Subject("frame")  # the one whose light field, row or line the finding stands in


@dataclass(frozen=True, slots=True)
class Wording:
    """How a code is told: its sentence with {facts}, what to do, and the page of the documents; how long it stands
    before it is told unasked, because it usually ends by itself."""

    level: Level
    sentence: str
    remedy: str = ""
    page: str = ""
    settles_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found. `facts` have their unit in the key (`sigma_ms`) and stand as JSON."""

    code: Code
    subject: Subject
    facts: Mapping[str, Value] = field(default_factory=lambda: _NO_FACTS)
    level: Level = Level.NOTE

    def __hash__(self) -> int:
        return hash((self.code, self.subject))

    def with_facts(self, **more: Value) -> Self:
        """It with more facts, or others."""
        return replace(self, facts={**self.facts, **_known(more)})

    def number(self, name: str) -> int:
        """A whole number of its facts; 0 where there is none of this name."""
        value = self.facts.get(name)
        return value if isinstance(value, int) else 0

    @property
    def kind(self) -> tuple[Code, Subject]:
        """What makes two findings the same, whatever their numbers."""
        return self.code, self.subject


def json_text(one: Finding) -> str:
    """A finding as an event of the ledger holds it."""
    return json.dumps(codec.plain(one), ensure_ascii=False)


def of_json_text(words: str) -> Finding | None:
    """The finding that a text holds as JSON, as an event of the ledger does; None for another text."""
    try:
        return codec.read_json(Finding, words)
    except codec.CodecError:
        return None


def finding(code: Code, subject: Subject, level: Level | None = None, **facts: Value) -> Finding:
    """A finding with its code's own level, unless another is given. A number that isn't finite is unknown: None."""
    return Finding(code, subject, _known(facts), WORDS[code].level if level is None else level)


def _known(facts: Mapping[str, Value]) -> dict[str, Value]:
    """Facts as JSON has them, and the codec reads them back."""
    return {name: None if isinstance(one, float) and not math.isfinite(one) else one for name, one in facts.items()}


def worst(found: Iterable[Finding]) -> Level:
    """The highest level among findings; `NOTE` of none."""
    return max((one.level for one in found), default=Level.NOTE)


def first_of_each(found: Iterable[Finding]) -> list[Finding]:
    """Each kind once, as it was found first, in that order."""
    first: dict[tuple[Code, Subject], Finding] = {}
    for one in found:
        first.setdefault(one.kind, one)
    return list(first.values())


def above_note(found: Iterable[Finding]) -> list[Finding]:
    """Those that stand between a result and "go"."""
    return [one for one in found if one.level > Level.NOTE]


def in_order(found: Sequence[Finding]) -> list[Finding]:
    """Worst first, then newest: `found` stands in the order of finding."""
    return sorted(found[::-1], key=lambda one: -one.level)  # noqa: C415  sorted() keeps the order of equals


class _Sentences(string.Formatter):
    """Formats facts as `str.format` does. `{reason:?: }` is empty, or ": " and the reason; `{frames:#frame}` is
    1 frame, 2 frames. Facts may come from damaged files: one that is missing, or of another type, is shown as it is.
    """

    def get_value(self, key: int | str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        return kwargs.get(str(key))

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec.startswith("?"):
            return "" if value in (None, "") else f"{format_spec[1:]}{value}"
        if format_spec.startswith("#") and isinstance(value, int):
            return f"{value} {format_spec[1:]}" + ("" if value == 1 else "s")
        try:
            return format(value, format_spec)
        except (ValueError, TypeError, OverflowError):
            return str(value)


def _filled(sentence: str, facts: Mapping[str, Value]) -> str:
    return _Sentences().vformat(sentence, (), facts)


def text(one: Finding) -> Text:
    """What was found, as a clause without its subject and without a full stop."""
    return Text(_filled(WORDS[one.code].sentence, one.facts))


def remedy(one: Finding) -> Text:
    """What to do; "" where nothing is to be done."""
    return Text(_filled(WORDS[one.code].remedy, one.facts))


def named(one: Finding, under: Subject | None = None) -> Text:
    """What was found, of what, where there are several such things or the result isn't about it.

    What stands `under` its subject's name needs it not again.
    """
    plain_one = one.subject.which == "" and one.subject.kind not in _BESIDE
    return text(one) if plain_one or one.subject == under else Text(f"{one.subject}: {text(one)}")


def told(one: Finding, under: Subject | None = None) -> Text:
    """What was found, of what, and what to do."""
    todo = remedy(one)
    return Text(f"{named(one, under)}: {todo}" if todo else str(named(one, under)))


def of_subject(found: Iterable[Finding], subject: Subject) -> list[Finding]:
    """What was found of the frame at hand, said of a subject that has a name."""
    return [replace(one, subject=subject) if one.subject == FRAME else one for one in found]


def first_by_name(frames: Iterable[tuple[str, Iterable[Finding]]]) -> list[Finding]:
    """What was found of frames, by their names: each code once, of the first of them.

    >>> clipped = finding(Code.FRAME_CLIPPED, FRAME, share=0.02)
    >>> [str(one.subject) for one in first_by_name([("7", [clipped]), ("8", [clipped])])]
    ['frame 7']
    """
    first: dict[tuple[Code, str], Finding] = {}
    for name, found in frames:
        for one in of_subject(found, Subject("frame", name)):
            first.setdefault((one.code, one.subject.kind), one)
    return list(first.values())


_TABLE = tomllib.loads(resources.files("dappled").joinpath("findings.toml").read_text("utf-8"))
WORDS: Mapping[Code, Wording] = MappingProxyType(
    {Code(code): Wording(Level[row.pop("level").upper()], **row) for code, row in _TABLE.items()}
)
