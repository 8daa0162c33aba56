"""The verbs of `dappled`, in the order of --help: the class of each, and its line there."""

from __future__ import annotations

# Nothing but --help or a completion was asked for: verbs' modules leave out what only their work needs. Set before one
# of them is loaded, in a process of its own.
words_only = False

# What actions belong to, and its line in --help.
GROUPS: dict[str, str] = {
    "keys": "make keys for subscribers on the network, and the console's token",
    "mavlink": "make keys for signed MAVLink links",
    "mask": "the printed mask: make, table, diffraction, design, and plan a flight with it",
    "flight": "recorded flights: list, show, check, report, coverage, offload, pickup",
    "terrain": "what the heights of maps tell: volumes between two flights, contours",
    "config": "check or show settings",
}

# Words of a verb: (module below `dappled.cli` and the verb's class in it, its line).
VERBS: dict[str, tuple[str, str]] = {
    "run": ("run:RunDaemon", "run the daemon: fire, record, tag, decode, publish"),
    "replay": ("replay:ReplayFlight", "run a recorded flight, or a folder of frames, through the same pipeline"),
    "doctor": ("doctor:ExamineMachine", "say what is missing on this machine; fire a test shot; measure latency"),
    "status": ("status:ShowStatus", "show the state of the running daemon"),
    "open": ("open:OpenInBrowser", "look at a recorded flight or a light field in the browser"),
    "watch": ("watch:WatchStream", "subscribe to the stream: show and save what arrives"),
    "keys make": ("keys:MakeKeys", "make a pair: NAME.key to give away, NAME.key_secret to keep"),
    "keys show": ("keys:ShowKey", "show the public key in a file"),
    "keys token": ("keys:MakeToken", "make a token for the console"),
    "keys seal": ("keys:MakeSealKey", "make a key that signs the seals of flights"),
    "trigger": ("trigger:AskForPhotographs", "ask for frames over MAVLink, as a ground station does"),
    "mavlink key": ("keys:MakeLinkKey", "make a key file for a signed link (see mavlink.keys)"),
    "decode": ("decode:DecodeFrames", "decode frames to light fields"),
    "picture": ("picture:MakePictures", "make photographs without the mask's shadow, at the sensor's own resolution"),
    "carriers": ("carriers:ShowCarriers", "show the predicted and the measured carriers of a frame"),
    "calibrate": ("calibrate:CalibrateMask", "fit lattice, law and phases to calibration frames"),
    "views": ("views:DrawViews", "draw a light field's views, slices or shifts as one picture"),
    "refocus": (
        "refocus:RefocusLightField",
        "refocus a light field: by α, disparity or metres, on a plane, as a stereo pair",
    ),
    "depth": ("depth:MeasureDepth", "measure disparities and distances with their uncertainty; write point clouds"),
    "export": ("export:ExportLightField", "write light fields for other tools: hci, eslf, mat, quilt, h5 …"),
    "mask make": ("mask.make:MakeMask", "write the image that goes on film, or a step wedge"),
    "mask table": ("mask.table:TabulateCarriers", "print where the carriers are over focal lengths (Tables 11 and 14)"),
    "mask diffraction": (
        "mask.diffraction:PredictDiffraction",
        "predict a laser's spots, and judge a print by the measured ones",
    ),
    "mask design": ("mask.design:DesignMask", "design mask, distance and film for an altitude"),
    "mask plan": ("mask.plan:PlanFlight", "plan a flight: interval, motion blur, frame rate and disk space"),
    "mask kit": (
        "mask.kit:WriteTestKit",
        "write what to print and shoot to settle a camera's carrier law: masks, wedge, target, shot list",
    ),
    "plan": ("mask.plan:PlanFlight", "plan a flight: interval, motion blur, frame rate and disk space"),
    "flight list": ("flight:ListFlights", "list all flights in a folder"),
    "flight show": ("flight:ShowFlight", "show every shot of a flight"),
    "flight check": ("flight:CheckFlight", "check that every byte is intact; exits 1 if not"),
    "flight report": (
        "flight:ReportFlight",
        "count which requests became frames; exits 1 if they don't agree, may lack some, or are in doubt",
    ),
    "flight seal": ("flight:SealFlight", "check a flight and sign it as it stands; exits 1 if it is not intact"),
    "flight offload": (
        "flight:OffloadFlight",
        "copy a flight to another disk and prove the copy (exits 1 in doubt); remove the frames here on request",
    ),
    "flight coverage": (
        "flight.coverage:CoverageOfFlight",
        "which ground the frames have seen, and the mission that flies the holes again; exits 1 where there are holes",
    ),
    "flight gnss": (
        "flight.gnss:WriteReceiverStream",
        "write the GNSS receiver's stream that a flight recorded (.ubx), for PPK",
    ),
    "flight pickup": (
        "flight.pickup:PickUpFiles",
        "fetch the files that stayed in the camera; exits 1 if shots still lack files",
    ),
    "geotag": ("geotag:TagFrames", "write positions and attitudes for other programs: XMP, geo.txt, CSV, GeoJSON"),
    "georeference": ("georeference:MapFlight", "make maps of a flight: KMZ overlay, GeoTIFF, footprints, terrain"),
    "terrain volume": (
        "terrain.volume:MeasureVolume",
        "measure how much was filled and cut between two flights, with its uncertainty",
    ),
    "terrain contours": ("terrain.contours:DrawContours", "draw lines of equal height (GeoJSON)"),
    "batch": ("batch:ProcessFlights", "process whole flights frame by frame, on all cores or a Dask cluster"),
    "hand-over": ("hand_over:HandOver", "give pictures to OpenDroneMap (NodeODM), and fetch the model"),
    "config check": ("config:CheckSettings", "check a settings file"),
    "config show": ("config:ShowSettings", "show every setting with its value, unit and meaning"),
    "init": ("init:InitSettings", "write a settings file: finds what is plugged in, and asks"),
    "completion": ("completion:PrintCompletion", "print a completion script for bash, zsh or fish"),
    "profiles": ("config:ListProfiles", "list the shipped camera and mask profiles"),
}
