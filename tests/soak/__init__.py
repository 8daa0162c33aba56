"""A long flight in which something goes wrong every few seconds."""
