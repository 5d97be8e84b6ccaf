"""Where `parameter_values` was; it is in `optics.lens`."""

from fisheye_svp_ros.optics.lens import parameter_values as parameter_values
