"""Similarities between maps that share no view, found through the body."""
