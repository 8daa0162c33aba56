"""Programs that nobody here wrote, driven by small scripts in processes of their own."""
