"""Reading and writing files: images, their transfer curves and metadata, numbered frames."""
