"""Drawings as SVG and PNG. The page's style sheet colours the SVG for light and dark colour schemes."""
