"""The torch mechanism of sparse training: layers, gradient masks, moments, clocks. Knows no SB3."""
