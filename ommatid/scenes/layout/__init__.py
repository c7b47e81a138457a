"""Where the sub-imagers of an array look, and where their patches lie on the sensor."""
