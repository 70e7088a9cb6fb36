"""Shows and controls a policy in the browser, through viser (`playground play --web`)."""
