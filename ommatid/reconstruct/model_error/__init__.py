"""Effect of the errors of a measured H on the estimate: the contrast they act on, and the attenuation they cause."""
