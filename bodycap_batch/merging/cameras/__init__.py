"""The path of each camera, cleaned and checked."""
