"""The names of methods and presets in text, the same on every page."""

METHODS = {
    "prune": "Pruning",
    "static": "Static",
    "set": "SET",
    "rigl": "RigL",
    "granet": "GraNet",
    "mst": "MST",
    "rlx2": "RLx2",
}
