"""Heights under the fitted light: multi-view stereo that does not mind the light changing."""
