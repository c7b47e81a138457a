"""What happens to light between target and pixel, in closed form: footprints, blur, distortion, radiometry."""
