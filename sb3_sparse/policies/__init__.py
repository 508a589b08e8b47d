"""The SB3 face: sparse policy classes and the names under which SB3 finds them."""
