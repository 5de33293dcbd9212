"""From a patch to a descriptor: the CrossLoc3D network, its weights and its compiled CPU runtime."""
