"""What programs can see: named objects, parts and the hand of one frozen snapshot, on a voxel grid."""
