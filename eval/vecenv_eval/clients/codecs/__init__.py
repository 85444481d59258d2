"""Messages of the protocols: what goes over the wire, in both directions; clients and servers share it."""
