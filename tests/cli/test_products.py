"""`dappled views`, `refocus`, `depth` and `export` as a person calls them."""

from __future__ import annotations

import json
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from dappled import codec
from dappled.cli import depth, main
from dappled.clock import RecordedClock
from dappled.decode.depth.ranging import Ranging
from dappled.decode.geometry import camera_pose
from dappled.findings import FRAME, Code, finding, told
from dappled.flight import recording
from dappled.products import opened
from dappled.products.exports import light_files
from dappled.products.maps.earth import Projection
from tests.flight.makers import deliver, pose, request, tag
from tests.products.fields import DISPARITY, light_field


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("field") / "frame.npz"
    light_files.save(path, light_field())
    return str(path)


def size(path: Path) -> tuple[int, int]:
    with Image.open(path) as picture:
        return picture.size


def test_views_that_the_model_did_not_make_are_told_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = light_field()
    small = finding(Code.VIEWS_SLICES_SMALL, FRAME, height_px=9, width_px=9, patch_px=24)
    told = {"views_model": "independent", "views_reason": codec.plain(small)}
    quick = replace(plain, attributes={**plain.attributes, **told})
    light_files.save(tmp_path / "f.npz", quick)
    words = "views of each spatial frequency by itself: slices of 9 × 9 px are smaller than a patch of 24 px"
    assert main(["views", str(tmp_path / "f.npz"), "-o", str(tmp_path / "a.png")]) == 0
    assert words in capsys.readouterr().out
    assert main(["export", str(tmp_path / "f.npz"), "--as", "npz", "-o", str(tmp_path / "g.npz")]) == 0
    assert capsys.readouterr() == (f"{tmp_path}/g.npz\n", f"{words}\n")
    assert main(["export", str(tmp_path / "f.npz"), "--as", "npz", "-o", str(tmp_path / "h.npz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["views"] == words


@pytest.mark.parametrize(
    ("verb", "name"), [("views", "a.png"), ("refocus", "a.png"), ("depth", "a.npz"), ("export", "a.mat")]
)
def test_what_is_made_of_a_light_field_in_doubt_is_in_doubt(
    verb: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, doubts = (
        light_field(),
        [finding(Code.FRAME_CLIPPED, FRAME, share=0.03), finding(Code.MASK_TURNED, FRAME, by_deg=0.1)],
    )
    light_files.save(tmp_path / "f.npz", replace(plain, attributes={**plain.attributes, "doubts": codec.plain(doubts)}))
    words = [verb, str(tmp_path / "f.npz"), "-o", str(tmp_path / name), *(["--as", "mat"] if verb == "export" else [])]
    assert main([*words, "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["doubts"] == codec.plain(doubts)
    lines = "".join(f"in doubt: light field {words[1]}: {told(doubt, FRAME)}\n" for doubt in reversed(doubts))
    assert said.err == f"{lines}dappled {verb}: done, but in doubt: see above; --anyway accepts that\n"
    (tmp_path / name).unlink()
    assert main([*words, "--anyway"]) == 0
    assert capsys.readouterr().err == lines


@pytest.mark.parametrize("of", ["views", "slices", "shifts", "slice-shifts"])
def test_views_as_one_picture(field: str, of: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if "shifts" in of:
        pytest.importorskip("cv2", reason="shifts need OpenCV, an extra")
    assert main(["views", field, "--of", of, "-o", str(tmp_path / "a.png")]) == 0
    assert size(tmp_path / "a.png")[0] > 200
    assert "5 × 5 views of 80 × 60 px" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["parallax", "focus"])
def test_an_animation_goes_round_the_aperture_or_through_the_scene(field: str, kind: str, tmp_path: Path) -> None:
    assert main(["views", field, "--animate", kind, "-o", str(tmp_path / "a.webp")]) == 0
    with Image.open(tmp_path / "a.webp") as made:
        assert made.size == (640, 480)
        count = getattr(made, "n_frames", 1)
        assert count >= 4
        shown = []
        for number in range(count):
            made.seek(number)
            shown.append(np.asarray(made.convert("L"), dtype=np.float64))
    assert np.abs(shown[0] - shown[count // 2]).mean() > 0.5, "something moves"
    cv2 = pytest.importorskip("cv2", reason="films need OpenCV, an extra")
    assert main(["views", field, "--animate", kind, "-o", str(tmp_path / "a.mp4")]) == 0
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert (int(film.get(cv2.CAP_PROP_FRAME_WIDTH)), int(film.get(cv2.CAP_PROP_FRAME_HEIGHT))) == (640, 480)
    film.release()
    assert main(["views", field, "--animate", kind, "-o", str(tmp_path / "a.gif")]) == 2
    assert main(["views", field, "--animate", kind, "--of", "slices", "-o", str(tmp_path / "b.webp")]) == 2


def test_without_webp_in_pillow_an_animation_is_refused_in_words(
    field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("PIL.features.check", lambda name: name != "webp")
    assert main(["views", field, "--animate", "parallax", "-o", str(tmp_path / "a.webp")]) == 1
    assert "this Pillow was built without WebP: install another, or name a .mp4" in capsys.readouterr().err
    assert not (tmp_path / "a.webp").exists()


@pytest.mark.parametrize(("side", "count"), [(1, 0), (2, 4), (3, 8)])
def test_few_views_are_animated_once_round_and_one_is_refused(
    side: int, count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(side * side):
        Image.new("L", (31, 21), 20 + 20 * number).save(tmp_path / f"{number}.png")
    code = main(["views", str(tmp_path), "--animate", "parallax", "-o", str(tmp_path / "a.webp")])
    said = capsys.readouterr()
    if not count:
        assert (code, "an animation of parallax needs views from several places" in said.err) == (1, True)
        return
    assert code == 0
    with Image.open(tmp_path / "a.webp") as made:
        assert (getattr(made, "n_frames", 1), made.size) == (count, (682, 462))


@pytest.mark.parametrize(("sigma", "told"), [([0.01, 0.02, 0.03], False), ([0.66, 1.63, 2.95], True), (None, False)])
def test_a_depth_map_without_relief_says_so(sigma: list[float] | None, told: bool) -> None:
    quartiles = None if sigma is None else [-0.03, -0.001, 0.02]
    report = {
        "method": "combined",
        "known": 0.9,
        "disparity_px": quartiles,
        "sigma_px": sigma,
        "no_distances": "no focus",
    }
    assert any("no relief is told" in line for line in depth.words(report)) == told


def test_four_alphas_become_one_picture(field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["refocus", field, "--alpha", "1", "0.98", "1.02", "1.04"]
    assert main([*words, "-o", str(tmp_path / "a.png")]) == 0
    assert "alpha = 1.04 (+0.52 px/view)" in capsys.readouterr().out
    assert size(tmp_path / "a.png")[0] > 2 * 80
    assert main([*words, "--magnify", "-o", str(tmp_path / "a.npy")]) == 0
    assert np.load(tmp_path / "a.npy").shape == (4, 60, 80)


def test_metres_focus_where_the_board_is(field: str, tmp_path: Path) -> None:
    metres = 50.0 / 7.4 / 5 * 50e-3 / (DISPARITY * 0.1)
    for name, words in (
        ("metres", ["--distance", str(metres), "--focus", "inf"]),
        ("disparity", ["--disparity", str(DISPARITY)]),
        ("tilt", ["--disparity", str(DISPARITY), "--tilt", "0.1", "0"]),
        ("disc", ["--disparity", str(DISPARITY), "--aperture", "0.5"]),
    ):
        assert main(["refocus", field, *words, "-o", str(tmp_path / f"{name}.npy")]) == 0
    a, b, c = (np.load(tmp_path / f"{name}.npy") for name in ("metres", "disparity", "tilt"))
    words = ["--disparity", str(DISPARITY), "--tilt", "0.1", "0", "--aperture", "0.3"]
    assert main(["refocus", field, *words, "-o", str(tmp_path / "narrow.npy")]) == 0
    assert np.nanmax(np.abs(np.load(tmp_path / "narrow.npy") - c)) > 1e-3
    np.testing.assert_allclose(a, b, atol=1e-5)
    assert np.nanmax(np.abs(b - c)) > 1e-3


def test_a_volume_in_focus_is_one_picture(field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    low, high = DISPARITY - 0.2, DISPARITY + 0.2
    words = ["refocus", field, "--volume", str(low), str(high), "-o", str(tmp_path / "volume.npy"), "--json"]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["disparities_px"] == [low, high]
    assert main(["refocus", field, "--disparity", str(DISPARITY), "-o", str(tmp_path / "plane.npy")]) == 0
    volume, plane = np.load(tmp_path / "volume.npy"), np.load(tmp_path / "plane.npy")
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(volume - plane)[inner].mean() < 0.1 * plane[inner].std()
    assert main([*words[:5], "--eyes", "anaglyph", "-o", str(tmp_path / "a.png")]) == 2
    assert "--volume doesn't go with --eyes" in capsys.readouterr().err


def test_fourier_tells_how_far_the_sum_is(field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["refocus", field, "--alpha", "1.03", "1", "--fourier", "-o", str(tmp_path / "a.png")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [float(line.split("by ")[1].split(" dB")[0]) > 35 for line in lines[:2]] == [True, True]
    again = ["--fourier", "-o", str(tmp_path / "a.png"), "--overwrite", "--json"]
    assert main(["refocus", field, "--disparity", "0.5", *again]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["file"], told["disparities_px"]) == (str(tmp_path / "a.png"), [0.5])
    assert told["notes"][0]["shift_and_add_psnr_db"] > 35


def test_stack_eyes_and_all_in_focus(field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stack = ["--stack", "0", "0.8", "5"]
    assert main(["refocus", field, *stack, "-o", str(tmp_path / "s.png")]) == 0
    index = str(tmp_path / "i.png")
    assert main(["refocus", field, *stack, "--all-in-focus", "--index", index, "-o", str(tmp_path / "f.npy")]) == 0
    assert np.load(tmp_path / "f.npy").shape == (60, 80)
    for form, wide in (("anaglyph", 80), ("side-by-side", 160), ("crossed", 160)):
        assert main(["refocus", field, "--eyes", form, "-o", str(tmp_path / f"{form}.png")]) == 0
        assert size(tmp_path / f"{form}.png") == (wide, 60)
    assert "have a sharpest picture" in capsys.readouterr().out


def test_all_in_focus_alone_takes_planes_through_the_scene(
    field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["refocus", field, "--all-in-focus", "-o", str(tmp_path / "f.npy"), "--json"]) == 0
    assert np.load(tmp_path / "f.npy").shape == (60, 80)
    (note,) = json.loads(capsys.readouterr().out)["notes"]
    assert note["from_px"] < DISPARITY < note["to_px"]


def test_depth_in_pixels_and_in_metres(field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["depth", field, "-o", str(tmp_path / "d.png"), str(tmp_path / "d.pfm")]) == 0
    assert "relative depth only" in capsys.readouterr().out
    words = ["depth", field, "--focus", "inf", "--json", "--between", "0", "1", "-o"]
    assert main([*words, *(str(tmp_path / f"m.{kind}") for kind in ("npz", "png", "ply"))]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["disparity_px"][1] == pytest.approx(DISPARITY, abs=0.01)
    assert told["points"] > 1000
    assert told["coordinates"] == "camera axes"
    with np.load(tmp_path / "m.npz") as made:
        assert set(made) == {"disparity", "sigma", "confidence", "distance_m", "distance_sigma_m"}
        assert float(np.nanmedian(made["distance_m"])) == pytest.approx(told["distance_m"][1])


@pytest.mark.parametrize("name", ["d.pfm", "d.npz"])
def test_a_full_disk_leaves_the_depth_map_of_before(
    field: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def torn(path: Path, *_: object, **__: object) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    (tmp_path / name).write_bytes(b"of before")
    monkeypatch.setattr("dappled.products.exports.exports.write_pfm", torn)
    monkeypatch.setattr("numpy.savez_compressed", torn)
    assert main(["depth", field, "--between", "0", "1", "-o", str(tmp_path / name), "--overwrite"]) == 1
    assert "can't be written: No space left on device" in capsys.readouterr().err
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [(name, b"of before")]


@pytest.mark.parametrize("mount", [camera_pose.NADIR, camera_pose.FORWARD], ids=["down", "ahead"])
def test_points_lie_where_the_flights_own_mount_looks(
    field: str, mount: camera_pose.Matrix, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    laspy = pytest.importorskip("laspy", reason="LAS is an extra")
    facts = {"settings": {"pose": {"mount": mount.ravel().tolist(), "lever_arm_m": [0.0, 0.0, 2.0]}}}
    level = replace(pose(), latitude_rad=0.72, longitude_rad=-1.6, altitude_msl_m=215.0, attitude=(1.0, 0.0, 0.0, 0.0))
    begun = recording.begin(tmp_path / "flights", RecordedClock(1_795_256_103_000_000_000), facts)
    request(begun, 0)
    begun.ledger.add_tag(replace(tag(deliver(begun, 0, b"a frame")), pose=level))
    begun.close()
    given = ["--focus", "inf", "--flight", str(begun.folder.path), "--frame", "0"]
    path = tmp_path / "points.las"
    assert main(["depth", field, *given, "-o", str(path), "--json"]) == 0
    crs = json.loads(capsys.readouterr().out)["coordinates"]
    found = laspy.read(path)
    east, north = Projection(crs).to_map(np.degrees(0.72), np.degrees(-1.6))
    metres = 50.0 / 7.4 / 5 * 50e-3 / (DISPARITY * 0.1)
    ahead = mount is camera_pose.FORWARD  # to the north, from 2 m below the antenna
    away = [np.median(found.y) - float(north), np.median(found.z) - 213.0]
    assert away == pytest.approx([metres, 0.0] if ahead else [0.0, -metres], abs=0.05)
    assert np.median(found.x) == pytest.approx(float(east), abs=0.05)


def test_a_calibration_of_another_zoom_is_refused_or_told(
    field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = "[ranging]\ngain_px_m = 40.0\noffset_px = 0.0\nf_number = 7.4\nfocal_length_mm = 12.8\n"
    (tmp_path / "wide.toml").write_text(table)
    assert main(["depth", field, "--calibration", str(tmp_path / "wide.toml")]) == 1
    assert "the frame's is 50 mm" in capsys.readouterr().err
    kept = opened.with_ranging(light_field(), Ranging.from_dict(tomllib.loads(table)["ranging"]))
    light_files.save(tmp_path / "kept.npz", kept)
    assert main(["depth", str(tmp_path / "kept.npz"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert "the frame's is 50 mm" in told["no_distances"]
    assert "distance_m" not in told


@pytest.mark.parametrize(
    ("kind", "name"),
    [("hci", "hci"), ("eslf", "e.png"), ("mat", "m.mat"), ("quilt", "q.png"), ("npz", "n.npz"), ("h5", "h.h5")],
)
def test_every_form_is_written(field: str, kind: str, name: str, tmp_path: Path) -> None:
    if kind == "h5":
        pytest.importorskip("h5py", reason="HDF5 is an extra")
    assert main(["export", field, "--as", kind, "-o", str(tmp_path / name)]) == 0
    assert any(tmp_path.iterdir())


class Recording:
    """Writes what is logged, as (name, kind), where Rerun's stream would write it."""

    def __init__(self, application: str) -> None:
        self.path, self.logged = Path(application), list[tuple[str, str]]()

    def save(self, path: str) -> None:
        self.path = Path(path)

    def log(self, name: str, kind: str, *, static: bool) -> None:
        assert static
        self.logged.append((name, kind))

    def flush(self) -> None:
        self.path.write_text(json.dumps(self.logged))

    def disconnect(self) -> None:
        """There is no connection."""


def test_a_rerun_recording_has_the_views_the_picture_and_the_depth(
    field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = {kind: lambda *_, kind=kind, **__: kind for kind in ("Image", "DepthImage", "Points3D")}
    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(RecordingStream=Recording, **kinds))
    path = tmp_path / "a.rrd"
    assert main(["export", field, "--as", "rerun", "--depth", "--focus", "inf", "-o", str(path)]) == 0
    logged = dict(json.loads(path.read_text()))
    assert logged["view/2/2"] == logged["picture"] == "Image"
    assert logged["disparity"] == logged["sigma"] == "DepthImage"
    assert logged["points"] == "Points3D"


@pytest.mark.slow  # Rerun is not in the smaller environment
def test_a_rerun_recording_is_written_and_can_be_read(field: str, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="an extra")
    path = tmp_path / "a.rrd"
    assert main(["export", field, "--as", "rerun", "--depth", "--focus", "inf", "-o", str(path)]) == 0
    assert path.read_bytes()[:4] in (b"RRF2", b"RRIO", b"RRF3")
    assert path.stat().st_size > 60 * 80


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["refocus", "{}", "--alpha", "0", "-o", "{out}.png"], "is not an image plane"),
        (["refocus", "{}", "--distance", "5", "-o", "{out}.png"], "has no distances"),
        (["refocus", "{}", "-o", "{out}.gif"], "must end in"),
        (["depth", "{}", "-o", "{out}.ply"], "has no distances"),
        (["depth", "{}", "--calibration", "{toml}"], "has no distances"),
    ],
)
def test_wrong_calls_are_one_sentence(
    field: str, words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.toml").write_text("law = 'fd'\n")
    filled = [w.replace("{}", field).format(out=tmp_path / "o", toml=tmp_path / "c.toml") for w in words]
    assert main(filled) == 1
    sentence = capsys.readouterr().err
    assert told in sentence
    assert sentence.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.toml"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["export", "{}", "--as", "npz", "-o", "{out}.h5"], "writes a .npz file"),
        (["refocus", "{}", "--magnify", "-o", "{out}.png"], "goes with --alpha"),
        (["refocus", "{}", "--eyes", "anaglyph", "--fourier", "-o", "{out}.png"], "--eyes doesn't go with --fourier"),
        (
            ["refocus", "{}", "--fourier", "--aperture", "0.3", "-o", "{out}.png"],
            "--fourier doesn't go with --aperture",
        ),
        (["refocus", "{}", "--eyes", "anaglyph", "--tilt", "1", "0", "-o", "{out}.png"], "doesn't go with --tilt"),
        (["refocus", "{}", "--alpha", "1", "--fourier", "--magnify", "-o", "{out}.png"], "doesn't go with --magnify"),
        (["refocus", "{}", "--all-in-focus", "--alpha", "1", "-o", "{out}.png"], "or those of --stack"),
        (["refocus", "{}", "--stack", "0", "1", "0.5", "-o", "{out}.png"], "not a number of pictures"),
        (["refocus", "{}", "--stack", "0", "1", "501", "-o", "{out}.png"], "at most 500"),
        (["depth", "{}", "--focus", "inf", "--flight", "{}", "-o", "{out}.ply"], "--frame N"),
        (["depth", "{}", "--window", "4"], "a window of 4 px"),
        (["views", "{}.gone.npz", "-o", "{out}.png"], "no such file"),
        (["views", "{}", "--row", "3", "-o", "{out}.png"], "--row and --column are of --of epi"),
    ],
)
def test_what_is_wrong_by_itself_ends_with_2_and_the_verb_s_own_usage(
    field: str, words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([w.replace("{}", field).format(out=tmp_path / "o") for w in words]) == 2
    usage, sentence = capsys.readouterr().err.splitlines()
    assert usage.startswith(f"usage: dappled {words[0]} ")
    assert told in sentence
    assert list(tmp_path.iterdir()) == []
