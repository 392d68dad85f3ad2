"""Messages of any plant to values of assets: topics, fields, times and units as a service file names them."""
