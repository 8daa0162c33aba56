"""What is made from frames and flights on the ground: light-field files, pictures."""
