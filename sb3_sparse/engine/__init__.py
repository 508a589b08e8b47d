"""The torch mechanism of sparse training: storages, gradient masks and clocks, without SB3."""
