"""`playground play --web`: a policy in the browser, drawn and steered through viser."""
