"""Many drives, one map: what each log says of cells is kept as sums, in tiles, and added where somebody looks."""
