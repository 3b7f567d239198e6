"""Drawings as SVG and PNG; the page's style sheet colours them for its light and dark schemes."""
