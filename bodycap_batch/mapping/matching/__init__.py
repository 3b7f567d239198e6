"""SIFT features of the keyframes, and verified matches between pairs of keyframes."""
