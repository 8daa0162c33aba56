"""Mathematics on arrays: masks, carriers, slices, views. No files, no sockets, no clock, no hardware."""
