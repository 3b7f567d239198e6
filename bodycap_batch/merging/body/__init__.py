"""The kinematic chain, and first poses of its bones."""
