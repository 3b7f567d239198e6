"""Drawings as SVG and PNG, coloured by the page's style sheet so that they follow light and dark."""
