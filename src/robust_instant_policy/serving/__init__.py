"""Policy servers: openpi's websocket protocol, and HTTP with JSON (docs/serving.md). Needs the extra `serve`."""
