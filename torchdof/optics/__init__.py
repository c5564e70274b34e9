"""From depth in metres to a signed circle of confusion in pixels, and from that to a point spread function."""
