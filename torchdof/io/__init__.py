"""Files in and out: images, their transfer curves and metadata, numbered frames."""
