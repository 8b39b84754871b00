"""The stripe of ordinary pictures: compiled search and maximum likelihood fit of a Gaussian."""
