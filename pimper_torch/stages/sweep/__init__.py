"""Heights under the fitted light: multi-view stereo under changing light."""
