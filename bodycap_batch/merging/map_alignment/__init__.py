"""Alignment of maps without common views: similarities between maps, estimated through the body."""
