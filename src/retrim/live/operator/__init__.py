"""The operator's part of a live flight: page, requests and manual disturbance."""
