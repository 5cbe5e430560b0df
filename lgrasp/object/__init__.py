"""Objects: mesh file to surface points, obstacle clusters and signed distance grid."""
