"""What the frames of a flight show together: terrain from their light fields, pictures refocused over them, changes."""
