"""From a scan to an estimate: retrieval, alignment, fusion."""
