"""Writers of standard files: point cloud, raster, mesh, trajectory."""
