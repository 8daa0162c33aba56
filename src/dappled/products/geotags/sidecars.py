"""Write XMP sidecars: a frame's position, attitude and times in the properties of Pix4D, drone-dji and EXIF."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import quoteattr

from dappled import codec, durable
from dappled.decode.geometry.camera_pose import CameraPose
from dappled.errors import DappledError
from dappled.flight import Tag, disk_errors

_HEAD_BYTES = 1 << 16
_MARK = "dappled"
_SPACES = {
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "exif": "http://ns.adobe.com/exif/1.0/",
    "Camera": "http://pix4d.com/camera/1.0/",
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "dappled": "urn:dappled:sidecar:1",
}

_RTK_FLAGS = {3: "16", 4: "16", 5: "34", 6: "50"}  # DJI's codes for a single, differential, float and fixed solution


def path_of(frame: Path, *, replace_extension: bool = False) -> Path:
    """The sidecar of a frame: `name.ext.xmp` (darktable, digiKam), or `name.xmp` (Lightroom)."""
    return frame.with_suffix(".xmp") if replace_extension else frame.with_name(frame.name + ".xmp")


def text(tag: Tag, camera: CameraPose | None, utc_ns: int | None) -> str:
    """The sidecar's text. `utc_ns` is the corrected mid-exposure. Unknown values are left out."""
    words = {**_of_tag(tag, utc_ns), **(_of_place(tag, camera) if camera else {})}
    spaces = "\n".join(f"    xmlns:{name}={quoteattr(uri)}" for name, uri in _SPACES.items())
    values = "\n".join(f"    {name}={quoteattr(value)}" for name, value in words.items() if value is not None)
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        f'  <rdf:Description rdf:about=""\n{spaces}\n{values}/>\n'
        ' </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>\n'
    )


def write(path: Path, content: str, *, force: bool = False) -> None:
    """Write a sidecar, whole or not at all. Raises DappledError for one that another program wrote (`force` replaces
    it), and FlightError when the disk refuses."""
    with disk_errors("write the sidecar", path):
        if not force and path.exists() and not _ours(path):
            raise DappledError(
                f"{path} was written by another program, and may have been edited by hand: "
                "move it away, write elsewhere with --output, or replace it with --force"
            )
        durable.write_file(path, content.encode())


def _ours(path: Path) -> bool:
    """Whether dappled wrote a sidecar; the mark stands near its beginning. Raises OSError."""
    with open(path, "rb", opener=durable.plain_file) as file:
        return f'xmp:CreatorTool="{_MARK}"'.encode() in file.read(_HEAD_BYTES)


def _of_tag(tag: Tag, utc_ns: int | None) -> dict[str, str | None]:
    pose = tag.pose
    return {
        "xmp:CreatorTool": _MARK,
        "exif:GPSTimeStamp": None if utc_ns is None else stamp(utc_ns),
        "dappled:ImageIndex": str(tag.index),
        "dappled:FrameSha256": tag.frame_sha256,
        "dappled:MidExposureUtcNs": None if utc_ns is None else str(utc_ns),
        "dappled:MidExposureSigmaNs": str(tag.utc_sigma_ns),
        "dappled:TimeSource": tag.time_source,
        "dappled:Doubts": json.dumps(codec.plain(tag.doubts)) if tag.doubts else None,
        "dappled:PoseSource": pose.source,
        "dappled:VehicleAttitudeWxyz": None if pose.attitude is None else " ".join(f"{q:.9f}" for q in pose.attitude),
        "dappled:GimbalAttitudeWxyz": None
        if pose.gimbal_attitude is None
        else " ".join(f"{q:.9f}" for q in pose.gimbal_attitude),
        "dappled:PositionSigmaM": _number(pose.position_sigma_m, 3),
        "dappled:VerticalSigmaM": _number(pose.vertical_sigma_m, 3),
        "dappled:AttitudeSigmaRad": _number(pose.attitude_sigma_rad, 6),
        "dappled:Camera": tag.camera,
        "dappled:Mask": tag.mask or None,
    }


def _of_place(tag: Tag, camera: CameraPose) -> dict[str, str | None]:
    sigma, gnss = tag.pose.position_sigma_m, tag.pose.gnss
    axis_sigma = None if sigma is None else sigma / 2**0.5
    words: dict[str, str | None] = {
        "exif:GPSVersionID": "2.3.0.0",
        "exif:GPSMapDatum": "WGS-84",
        "exif:GPSLatitude": _minutes(camera.latitude_deg, "NS"),
        "exif:GPSLongitude": _minutes(camera.longitude_deg, "EW"),
        "exif:GPSAltitude": f"{round(abs(camera.altitude_msl_m) * 1000)}/1000",
        "exif:GPSAltitudeRef": "1" if camera.altitude_msl_m < 0 else "0",
        "exif:GPSHPositioningError": None if sigma is None else f"{round(sigma * 1000)}/1000",
        "exif:GPSDOP": None if gnss is None or gnss.hdop is None else f"{round(gnss.hdop * 100)}/100",
        "exif:GPSSatellites": None if gnss is None or gnss.satellites is None else str(gnss.satellites),
        "Camera:GPSXYAccuracy": _number(sigma, 3),
        "Camera:GPSZAccuracy": _number(tag.pose.vertical_sigma_m, 3),
        "drone-dji:AbsoluteAltitude": f"{camera.altitude_msl_m:+.3f}",
        "drone-dji:RelativeAltitude": None
        if camera.height_above_home_m is None
        else f"{camera.height_above_home_m:+.3f}",
        "drone-dji:GpsLatitude": f"{camera.latitude_deg:.9f}",
        "drone-dji:GpsLongitude": f"{camera.longitude_deg:.9f}",
        "drone-dji:RtkStdLat": _number(axis_sigma, 4),
        "drone-dji:RtkStdLon": _number(axis_sigma, 4),
        "drone-dji:RtkStdHgt": _number(tag.pose.vertical_sigma_m, 4),
        "drone-dji:RtkFlag": None if gnss is None else _RTK_FLAGS.get(gnss.fix_type),
        "dappled:EllipsoidalHeightM": _number(camera.height_ellipsoid_m, 3),
        "dappled:LeverArmApplied": str(camera.lever_applied),
    }
    if camera.pix4d and camera.dji and camera.vehicle:
        words |= {
            "Camera:Yaw": f"{camera.pix4d.yaw_deg:.4f}",
            "Camera:Pitch": f"{camera.pix4d.pitch_deg:.4f}",
            "Camera:Roll": f"{camera.pix4d.roll_deg:.4f}",
            "drone-dji:GimbalYawDegree": f"{_signed(camera.dji.yaw_deg):+.4f}",
            "drone-dji:GimbalPitchDegree": f"{camera.dji.pitch_deg:+.4f}",
            "drone-dji:GimbalRollDegree": f"{camera.dji.roll_deg:+.4f}",
            "drone-dji:FlightYawDegree": f"{_signed(camera.vehicle.yaw_deg):+.4f}",
            "drone-dji:FlightPitchDegree": f"{camera.vehicle.pitch_deg:+.4f}",
            "drone-dji:FlightRollDegree": f"{camera.vehicle.roll_deg:+.4f}",
        }
    return words


def stamp(utc_ns: int) -> str:
    """A time as ISO 8601 has it, to the microsecond."""
    taken = datetime.fromtimestamp(utc_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{taken}.{utc_ns % 10**9 // 1000:06d}Z"


def _minutes(degrees: float, signs: str) -> str:
    """XMP's form of a coordinate: "41,38.1661234N"."""
    units = round(abs(degrees) * 60 * 10**7)  # rounded first: no 60.0000000 minutes
    whole, rest = divmod(units, 60 * 10**7)
    return f"{whole},{rest // 10**7}.{rest % 10**7:07d}{signs[degrees < 0]}"


def _number(value: float | None, digits: int) -> str | None:
    return None if value is None else f"{value:.{digits}f}"


def _signed(degrees: float) -> float:
    return degrees - 360 if degrees > 180 else degrees
