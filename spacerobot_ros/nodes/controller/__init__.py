"""The coordinated-control node."""
