"""The devices and processes that share the work: seeds mapped over them, batches split among them, programs compiled."""
