"""Work on people's own files, without a robot."""
