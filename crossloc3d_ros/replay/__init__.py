"""A recording through the localizer: in this process, or played into the real node over DDS."""
