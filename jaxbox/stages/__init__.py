"""The stages of the detector, one file a section of the paper; they meet in `jaxbox.stages.state`."""
