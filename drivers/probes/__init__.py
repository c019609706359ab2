"""Touch probes, read through digital inputs."""
