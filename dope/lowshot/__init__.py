"""Low-shot recognition with dense descriptors: episodes, local matching, the protocol and its result rows."""
