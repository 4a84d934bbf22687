"""One viewpoint, many lights: photometric stereo, normal integration, response curves."""
