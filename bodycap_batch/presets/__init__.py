"""Data files of the skeleton presets: bones, camera mounts and joint names."""
