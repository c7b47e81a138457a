"""Light between target and pixel: footprints, rays and waves through lenses, distortion, radiometry."""
