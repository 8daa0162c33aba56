"""What a person configures: settings, camera and mask profiles, and errors that say where and what."""
