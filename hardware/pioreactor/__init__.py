"""The driver of Pioreactors: from the vendor's HTTP and MQTT to samples, doses and faults of any number of units."""
