"""Pure arithmetic of sparse networks: integers and NumPy arrays in, integers and arrays out."""
