"""How good are the boxes: KITTI's protocol, overlaps, and the errors of size."""
