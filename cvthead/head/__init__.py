"""The parametric head: geometry, mesh hierarchy and ARKit units."""
