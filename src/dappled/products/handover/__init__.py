"""Write a flight as pictures and poses for the programs that make models of them."""

FORMS = ("colmap", "nerfstudio", "stac", "mcap")
KINDS = {  # what is made of each frame, and the ending of its file
    "npz": ".npz",
    "zarr": ".zarr",
    "h5": ".h5",
    "cog": ".tif",
    "kmz": ".kmz",
    "photos": "",
    **dict.fromkeys(FORMS, ""),
}
